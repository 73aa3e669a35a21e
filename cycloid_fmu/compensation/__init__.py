"""Compensation: the motor angle at which a known drive's output stands where it should, for a controller."""
