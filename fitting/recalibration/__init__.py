"""Recalibration in place: updates an identified drive, with the drift since the last date and a test of the model."""
