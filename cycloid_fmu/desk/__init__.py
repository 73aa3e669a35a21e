"""The designer's desk: values of a pair file in, drawing, curves, figures and verdicts out; in Python and as a page."""
