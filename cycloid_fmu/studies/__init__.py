"""Studies of many drives: tolerances and their allocation, sweeps."""
