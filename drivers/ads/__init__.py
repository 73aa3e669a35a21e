"""Beckhoff PLCs by ADS: a ring of numbered samples in the PLC, and one thread for each that reads it in blocks."""
