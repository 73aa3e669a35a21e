"""Drives on bearings: discs on cranks or an eccentric, and a carrier in its main bearing."""
