"""The kinds of error that a drive can have: names, signs and limits, and how each displaces flank, pin or body."""
