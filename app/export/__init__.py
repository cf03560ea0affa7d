"""The command `export`: the library in its folder, and how large it is."""
