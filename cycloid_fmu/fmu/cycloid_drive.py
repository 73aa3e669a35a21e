"""The script inside the FMU: it finds the slave in the installed package, where numba's compiled kernels are cached.

Before that it makes up for two faults of pythonfmu 0.7.0's library, which free memory that is still in use.
"""

import atexit
import contextlib
import ctypes
import sys
from pathlib import Path

# At each instantiation pythonfmu runs this script once more in a namespace of its own, and then gives back a reference
# to the module's globals that it never took.
if locals() is not globals():
    ctypes.pythonapi.Py_IncRef(ctypes.py_object(globals()))
# At exit on Linux it gives back a static object twice; released early, there is nothing left to give back. The folder
# of this instance's resources is the first of the path while this script runs.
if sys.platform == "linux":
    with contextlib.suppress(OSError, AttributeError):
        _library = Path(sys.path[0]).parent / "binaries" / "linux64" / "CycloidDrive.so"
        atexit.register(ctypes.CDLL(str(_library)).finalizePythonInterpreter)

try:
    from cycloid_fmu.fmu.slave import DriveSlave2
except ImportError as problem:
    raise ImportError(f"this FMU needs the Python package cycloid-fmu in the host's Python: {problem}") from problem


class CycloidDrive(DriveSlave2):
    """Cycloid-pin gear drive; the class' name is the FMU's model identifier."""
