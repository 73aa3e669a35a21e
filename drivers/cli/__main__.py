"""`python -m drivers.cli`."""

from drivers.cli import main

main()
