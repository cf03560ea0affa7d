"""The documents as a site: the input of MkDocs in addition to the Markdown in `docs`."""
