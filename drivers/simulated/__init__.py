"""A test bench that is simulated, in the same frames and bytes as a real one."""
