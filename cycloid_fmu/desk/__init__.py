"""The designer's desk: drawing, curves, figures and verdicts for a pair file's values, in Python and as a page."""
