"""Recordings of test benches: formats and readers, mapping of channels, cleaning, alignment on one clock."""
