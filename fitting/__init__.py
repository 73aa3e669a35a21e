"""From bench recordings to transmission error curves, the standard figures and the actual errors of a drive."""
