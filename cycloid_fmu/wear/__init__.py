"""Wear of flanks and pins over a drive's life."""
