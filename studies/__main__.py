"""`python -m studies NAME`, in the folder of a clone."""

from studies.cli import main

main()
