"""The script inside an FMI 3.0 FMU: it imports the slave from the installed package."""

try:
    from cycloid_fmu.fmu.slave3 import DriveSlave3 as Fmi3Slave
except ImportError as problem:
    raise ImportError(f"this FMU needs the Python package cycloid-fmu in the host's Python: {problem}") from problem


class CycloidDrive(Fmi3Slave):
    """Cycloid-pin gear drive; the class' name is the FMU's model identifier."""
