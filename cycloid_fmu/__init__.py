"""Contact model of cycloid-pin gear drives and the FMU made from it."""

from importlib.metadata import version

__version__ = version("cycloid-fmu")
