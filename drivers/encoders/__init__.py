"""The encoder protocols of this package."""
