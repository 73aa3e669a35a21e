"""Compensation: the motor angle for a desired output angle of a known drive, for controllers."""
