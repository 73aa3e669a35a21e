"""Recordings of test benches: formats and their readers, mapping of channels, inspection of unknown files."""
