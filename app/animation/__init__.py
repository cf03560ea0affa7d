"""Films of a drive: what was recorded of it, the pictures, the files."""
