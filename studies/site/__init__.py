"""Site of the documents: input of MkDocs in addition to the Markdown in `docs`."""
