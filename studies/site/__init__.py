"""Site of the documents: pages and files for MkDocs in addition to the Markdown in `docs`."""
