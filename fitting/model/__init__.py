"""The observation model: what curves and loops measure of a drive, priors, and which errors they resolve."""
