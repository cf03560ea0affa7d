"""The gallery of the documents: films of chosen drives, each with the command that makes it."""
