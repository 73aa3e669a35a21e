"""Recordings of test benches: formats and readers, the mapping of channels, cleaned and on one clock."""
