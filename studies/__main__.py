"""Entry point of `python -m studies NAME`, for use in a clone."""

from studies.cli import main

main()
