"""A drive's model brought up to date in place: what has drifted since it was last known, and whether it still holds."""
