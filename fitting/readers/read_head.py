"""The angle error of a single read head when the load displaces its shaft, and recordings corrected for it.

Torque bends and tilts a bench's shafts (Liu et al., 2022, section 2). A disc displaced by Y does not rotate, but a
single head at the radius R_d reads the angle Y/R_d, with Y the component along the head's direction of reading; two
opposite heads would cancel it. The displacement over torque is measured or computed once and used as a straight line.
"""

from __future__ import annotations

import dataclasses
import math
import os
from pathlib import Path
from typing import Annotated

import numpy as np
import pydantic
from numpy.typing import ArrayLike, NDArray

from cycloid_fmu import edge
from cycloid_fmu.geometry.sizes import PositiveLength
from fitting.readers.recording import Recording

Array = NDArray[np.float64]
FORMAT = "cycloid-read-head/1"


@dataclasses.dataclass(frozen=True)
class Displacement:
    """Radial displacement of a shaft over torque, Y = slope T + offset.

    Attributes
    ----------
    slope, offset
        Slope, m/(N·m), and offset, m.
    covariance
        Covariance of slope and offset, shape (2, 2).
    scatter
        Standard deviation of the measured displacements about the line, m.
    low, high
        Lowest and highest measured torque, N·m.
    """

    slope: float
    offset: float
    covariance: Array
    scatter: float
    low: float
    high: float


@dataclasses.dataclass(frozen=True)
class ReadHead:
    """A single head on a disc.

    Attributes
    ----------
    radius, radius_uncertainty
        Reading radius R_d and its standard uncertainty, m.
    direction
        Angle from the head's position on the disc to the direction of the displacement, counter-clockwise positive,
        rad: at +90° the displacement moves the disc under the head as a counter-clockwise rotation would.
    displacement
        Displacement of the shaft at the disc.
    """

    radius: float
    radius_uncertainty: float
    direction: float
    displacement: Displacement


class _Head(edge.Config):
    """A single read head on a disc.

    Attributes
    ----------
    radius, radius_uncertainty
        Reading radius and its standard uncertainty, m.
    direction
        Angle from the head to the direction of the displacement, rad, counter-clockwise positive: at +90° the
        displacement moves the disc under the head as a counter-clockwise rotation would.
    displacement
        CSV file of the shaft's displacement at the disc over the torque, relative to this file.
    """

    radius: PositiveLength
    radius_uncertainty: Annotated[edge.Length, pydantic.Field(ge=0.0)] = 0.0
    direction: edge.Angle = 0.5 * math.pi
    displacement: str


class _File(edge.Config):
    """A read head on a shaft that the load displaces."""

    read_head: _Head


def fit_displacement(torque: ArrayLike, displacement: ArrayLike) -> Displacement:
    """Return the least squares line of displacements, m, over torques, N·m, both of shape (points,).

    Raises
    ------
    ValueError
        If there are fewer than three points or fewer than two torques.
    """
    t, y = np.asarray(torque, dtype=float), np.asarray(displacement, dtype=float)
    if t.size < 3 or np.ptp(t) == 0.0:
        raise ValueError("a line with its uncertainty needs at least three points and two torques")
    (slope, offset), covariance = np.polyfit(t, y, 1, cov=True)
    scatter = math.sqrt(float(((y - slope * t - offset) ** 2).sum()) / (t.size - 2))
    return Displacement(float(slope), float(offset), covariance, scatter, float(t.min()), float(t.max()))


def angle_error(head: ReadHead, torque: ArrayLike) -> tuple[Array, Array]:
    """Return the angle error of a head and its standard uncertainty, rad, of the shape of `torque`, N·m.

    The uncertainty includes that of the line, the scatter about it and that of the radius (GUM, first order).
    """
    t, d = np.asarray(torque, dtype=float), head.displacement
    share = math.sin(head.direction) / head.radius
    moved = d.slope * t + d.offset
    line = d.covariance[0, 0] * t**2 + 2.0 * d.covariance[0, 1] * t + d.covariance[1, 1]
    uncertainty = np.abs(share) * np.sqrt(line + d.scatter**2 + (moved * head.radius_uncertainty / head.radius) ** 2)
    return share * moved, uncertainty


def without_coaxiality_error(recording: Recording, head: ReadHead) -> Recording:
    """Return a recording corrected for its read head's coaxiality error; a note states the correction."""
    error, uncertainty = angle_error(head, recording.torque)
    d = head.displacement
    notes = [
        f"{recording.source}: the output angle is corrected by {-error.max() * edge.ARCSEC:.4f} … "
        f"{-error.min() * edge.ARCSEC:.4f}″ for the read head's coaxiality, standard uncertainty "
        f"{uncertainty.max() * edge.ARCSEC:.4f}″."
    ]
    if recording.torque.min() < d.low or recording.torque.max() > d.high:
        notes.append(
            f"{recording.source}: the torque ranges from {recording.torque.min():g} to {recording.torque.max():g} N·m, "
            f"the displacement is known from {d.low:g} to {d.high:g} N·m; it is extrapolated beyond."
        )
    return dataclasses.replace(recording, output_angle=recording.output_angle - error, notes=(*recording.notes, *notes))


def read_read_head(path: str | os.PathLike[str]) -> ReadHead:
    """Return the read head of a TOML file; its table of displacements (CSV) is next to it.

    Raises
    ------
    edge.InputError
        If a file is invalid; one sentence that names file, field and value.
    """
    table = edge.toml_table(edge.read_text(path, FORMAT), FORMAT, str(path))
    head = edge.validated(_File, table, str(path)).read_head
    source = Path(path).parent / head.displacement
    rows = [values for _, values in edge.number_rows(source, {"torque": "N*m", "displacement": "m"})]
    torque, displacement = (np.array([row[name] for row in rows]) for name in ("torque", "displacement"))
    try:
        line = fit_displacement(torque, displacement)
    except ValueError as problem:
        raise edge.InputError(f"{source}: {problem}.") from None
    return ReadHead(head.radius, head.radius_uncertainty, head.direction, line)
