"""The protocols of this package."""
