"""The gear pair as drawn: values, validation and the flank's profile."""

import math

# Here, because the commands' help needs them without loading anything else.
ANGLES = 367  # crank angles per turn by default: a prime, so that it has no factor in common with the number of pins
CRANK_SPEED = 1000.0 * math.pi / 30.0  # rad/s, for a bearing's life in hours where nobody states a speed
