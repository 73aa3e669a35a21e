"""Estimation of a drive's errors: the fit, its statement, plans of bench runs and ensembles."""
