"""Drives on bearings: discs that float on cranks or an eccentric, a carrier in its main bearing."""
