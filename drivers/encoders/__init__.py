"""The protocols that this package speaks."""
