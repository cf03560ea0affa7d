"""What people touch: the command line, and what stands behind each of its commands."""
