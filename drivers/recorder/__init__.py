"""From the wiring of a bench to its recordings."""
