"""The gear pair as drawn: values, validation and the flank's profile."""

# Here, where nothing is loaded with it: the commands' help states it.
ANGLES = 367  # of a sweep over a crank turn where no one says: a prime, so that no number of pins is in step with it
