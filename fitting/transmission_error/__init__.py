"""Transmission error curves, folded from recordings."""
