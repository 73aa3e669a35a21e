"""The script inside an FMI 2.0 FMU: it imports the slave from the installed package with its cached numba kernels."""

import ctypes

# At each instantiation pythonfmu 0.7.0 runs this script again in a separate namespace, and then releases a reference to
# the module's globals that it never took.
if locals() is not globals():
    ctypes.pythonapi.Py_IncRef(ctypes.py_object(globals()))

try:
    from cycloid_fmu.fmu.slave import DriveSlave2
except ImportError as problem:
    raise ImportError(f"this FMU needs the Python package cycloid-fmu in the host's Python: {problem}") from problem


class CycloidDrive(DriveSlave2):
    """Cycloid-pin gear drive; the class' name is the FMU's model identifier."""
