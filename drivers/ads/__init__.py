"""Beckhoff PLCs over ADS: a ring buffer of numbered samples in the PLC, read in blocks by one thread per PLC."""
