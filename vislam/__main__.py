"""`python -m vislam` is the command line."""

from vislam.cli import main

main()
