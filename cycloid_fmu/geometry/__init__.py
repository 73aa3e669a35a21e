"""The gear pair as drawn: values, validation and the flank's profile."""

# Here, because the commands' help needs it without loading anything else.
ANGLES = 367  # crank angles per turn by default: a prime, so that it has no factor in common with the number of pins
