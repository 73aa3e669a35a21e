"""The script inside the FMU: it finds the slave in the installed package, where numba's compiled kernels are cached."""

try:
    # pythonfmu looks for the text "class NAME(Fmi2Slave):"; without it, it loses a reference to this module at each
    # instantiation, and the module is freed while it is in use.
    from cycloid_fmu.fmu.slave import DriveSlave as Fmi2Slave
except ImportError as problem:
    raise ImportError(f"this FMU needs the Python package cycloid-fmu in the host's Python: {problem}") from problem


class CycloidDrive(Fmi2Slave):
    """Cycloid-pin gear drive; the class' name is the FMU's model identifier."""
