"""The script inside an FMI 2.0 FMU: it finds the slave in the installed package, where numba's kernels are cached."""

import ctypes

# At each instantiation pythonfmu 0.7.0 runs this script once more in a namespace of its own, and then gives back a
# reference to the module's globals that it never took.
if locals() is not globals():
    ctypes.pythonapi.Py_IncRef(ctypes.py_object(globals()))

try:
    from cycloid_fmu.fmu.slave import DriveSlave2
except ImportError as problem:
    raise ImportError(f"this FMU needs the Python package cycloid-fmu in the host's Python: {problem}") from problem


class CycloidDrive(DriveSlave2):
    """Cycloid-pin gear drive; the class' name is the FMU's model identifier."""
