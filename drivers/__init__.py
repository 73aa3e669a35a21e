"""Encoders over serial and CAN, the recorder and the simulated test bench."""
