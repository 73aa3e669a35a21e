"""Where results lie outside what the model is made for."""

from __future__ import annotations

import itertools
import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cycloid_fmu import edge
from cycloid_fmu.contact.transmission import Transmission
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.geometry.pair import Pair
from cycloid_fmu.geometry.temperature import missing_for_clearances

Array = NDArray[np.float64]
_LARGEST_TILT_ERROR = 0.02 / edge.ARCSEC  # rad
_LARGEST_HALF_WIDTH = 0.25  # of the pin's radius: Hertz's half space ends there
_PHASES = 24  # of the mesh: as many show the ripple of the 39/40 example within 5 %


def tilt_error(pair: Pair, tilt: ArrayLike) -> Array:
    """Return the largest error of the transmission error by what slices neglect of a tilted gear, β²/2K, rad.

    Parameters
    ----------
    pair
        For its shortening coefficient K.
    tilt
        β, the angle of the gear's axis from the pins' axes, rad.

    Notes
    -----
    Slices are displaced; that sections of a tilted gear are wider along the tilt is neglected (docs/theory/errors.md).
    """
    return np.asarray(0.5 * np.square(tilt) / pair.shortening)


def notes(drive: DriveValue, found: Transmission) -> list[str]:
    """Return where results lie outside what the model is made for, one sentence each, none where all is well.

    Parameters
    ----------
    drive
        Its pair's `largest_pressure` and rated torque are what results are held against.
    found
        Of `solve`.
    """
    pair = drive.pair
    said = []
    limit, largest = pair.largest_pressure, found.max_contact_pressure.max(initial=0.0)
    if limit is None and largest > 0.0:
        said.append(
            f"The contact pressure of {largest * 1e-6:.0f} MPa was not judged: of a material that is neither steel nor "
            "named no limit is known; state [material.gear] name, or [pair] pressure_limit."
        )
    elif limit is not None and largest > limit.pressure:
        said.append(
            f"The contact pressure reaches {largest * 1e-6:.0f} MPa, above {limit.pressure * 1e-6:.0f} MPa"
            + (f" {limit.basis}" if limit.basis else "")
            + ": real flanks and pins deform for good there, and the model does not."
        )
    pressed = found.pin_pressure > 0.0
    half = 2.0 * found.pin_force[pressed] / (math.pi * pair.face_width * found.pin_pressure[pressed])
    if half.max(initial=0.0) > _LARGEST_HALF_WIDTH * pair.pin_radius:
        said.append(
            f"The contact's half width reaches {half.max() * 1e3:.3g} mm with a pin radius of "
            f"{pair.pin_radius * 1e3:.3g} mm: Hertz's law holds only for contacts that are narrow beside the pin."
        )
    if pair.rated_torque is not None and np.abs(found.torque).max(initial=0.0) > pair.rated_torque:
        torque = found.torque[np.abs(found.torque).argmax()]
        said.append(f"The torque {torque:g} N*m is above the rated torque, {pair.rated_torque:g} N*m.")
    said += interference_notes(found)
    said += tilt_notes(drive)
    if missing := missing_for_clearances(pair):
        said.append(f"Clearances stay as drawn at these temperatures; not stated are: {', '.join(missing)}.")
    return said


def tilt_notes(drive: DriveValue, tilt: float | None = None, of: str = "The gear's axis is tilted by") -> list[str]:
    """Return one sentence if the gear is tilted so far that slices err by more than 0.02″, none otherwise.

    Parameters
    ----------
    drive
        The drive, for its shortening coefficient and its own tilt.
    tilt
        Angle of the gear's axis from the pins' axes, rad; None for that of the drive. For several drives, such as
        those within tolerances, the largest.
    of
        The sentence's beginning, up to the angle.
    """
    if tilt is None:
        tilt = math.hypot(drive.displacements["tilt_x"], drive.displacements["tilt_y"])
    error = float(tilt_error(drive.pair, tilt))
    if not error > _LARGEST_TILT_ERROR:
        return []
    limit = math.sqrt(2.0 * drive.pair.shortening * _LARGEST_TILT_ERROR)
    return [
        f"{of} {tilt * 1e3:.3g} mrad, modelled to first order: the transmission error is uncertain by "
        f"{error * edge.ARCSEC:.2g}″ (0.02″ at {limit * 1e3:.2g} mrad)."
    ]


def interference_notes(found: Transmission) -> list[str]:
    """Return one sentence if flanks and pins interfere without a torque, none otherwise."""
    if not found.interference.max(initial=0.0) > 0.0:
        return []
    pressed = ""
    if found.preload is not None and found.preload_count is not None:
        most = int(found.preload.argmax())
        pressed = f", and {found.preload_count[most]} pins are pressed by up to {found.preload[most]:.3g} N"
    return [
        f"Without load flanks and pins interfere by up to {found.interference.max() * 1e6:.3g} um{pressed}: there is "
        "no play between them. To remove material, take an isometric above zero or an offset below zero."
    ]


def step_notes(pins: int, angles: int, turns: int) -> list[str]:
    """Return one sentence if crank angles are in step with the pins, so that few phases of the mesh are met.

    Parameters
    ----------
    pins
        Number of pins.
    angles, turns
        Number of crank angles, evenly from 0 over so many crank turns, end excluded.

    Examples
    --------
    >>> step_notes(40, 367, 1)
    []
    >>> step_notes(40, 80, 1)
    ['80 crank angles meet only 2 phases of the mesh of 40 pins: what lies between is missed; take 81.']
    """
    phases = angles // math.gcd(angles, turns * pins)
    if phases >= min(angles, _PHASES):
        return []
    return [
        f"{angles} crank angles meet only {phases} phase{'s' * (phases > 1)} of the mesh of {pins} pins: what lies "
        f"between is missed; take {out_of_step(pins, angles, turns)}."
    ]


def out_of_step(pins: int, least: int, turns: int = 1) -> int:
    """Return the next number of crank angles, from `least` on, each of which meets another phase of the mesh.

    The other arguments are those of `step_notes`.

    Examples
    --------
    >>> out_of_step(40, 90), out_of_step(12, 90)
    (91, 91)
    """
    return next(n for n in itertools.count(least) if math.gcd(n, turns * pins) == 1)
