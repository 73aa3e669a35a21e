"""The observation model: curves and loops of a drive, priors, and the errors that they resolve."""
