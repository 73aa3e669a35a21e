"""A kind of error that the product does not have, in one file of its own: the pin ring distorted by five screws."""

import numpy as np

from cycloid_fmu import ErrorKind
from cycloid_fmu.errors.kinds import Tolerance


def distortion(pair, amount):
    return amount * np.cos(5.0 * 2.0 * np.pi * np.arange(pair.pins) / pair.pins)


RING_DISTORTION = ErrorKind(
    "ring_distortion",
    "distortion of the pin ring by five screws",
    "> 0 outwards at each screw, the first at pin 0",
    "drive",
    {"pin_radial": distortion},
    breaks="pins",
    tolerance=Tolerance("ring_distortion"),
)
