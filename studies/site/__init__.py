"""The documents as a site: what MkDocs needs beside the Markdown in `docs`."""
