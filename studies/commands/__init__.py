"""The commands of the studies: what each takes, and how it begins."""
