"""The command `cycloid-bench`."""

from drivers.cli.commands import app, main

__all__ = ["app", "main"]
