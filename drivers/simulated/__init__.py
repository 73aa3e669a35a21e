"""A simulated test bench, with the same frames and bytes as a real one."""
