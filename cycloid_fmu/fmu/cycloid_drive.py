"""The script inside the FMU: it finds the slave in the installed package, where numba's compiled kernels are cached."""

try:
    from cycloid_fmu.fmu.slave import CycloidDrive as CycloidDrive
except ImportError as problem:
    raise ImportError(f"this FMU needs the Python package cycloid-fmu in the host's Python: {problem}") from problem
