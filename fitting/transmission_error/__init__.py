"""Transmission error curves: folded from recordings, and the read head's coaxiality error."""
