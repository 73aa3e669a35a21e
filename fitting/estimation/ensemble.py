"""Error surfaces drawn from what a fit leaves open: drives that measurements cannot tell from the identified one."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu import edge
from cycloid_fmu.drive import Drive
from cycloid_fmu.surfaces.structured import structured_value, with_structured
from fitting.model.observations import scatter_names, with_scatter

Array = NDArray[np.float64]


def ensemble(drive: Drive, count: int = 20, seed: int = 0) -> list[Drive]:
    """Draw drives that measurements cannot tell from an identified one, from the normal distribution of its fit.

    Parameters
    ----------
    drive
        `Identification.drive`, or another whose surface has the covariance of a fit.
    count, seed
        How many; the same seed draws the same.

    Returns
    -------
    drives
        Their surfaces have no covariance; seed and number are in the surfaces' attributes.

    Raises
    ------
    edge.ArgumentError
        If the surface has no covariance.

    Examples
    --------
    >>> import cycloid_fmu as cy, fitting, numpy as np
    >>> pair = cy.Pair(gear_teeth=9, pin_circle_radius=0.04, pin_radius=0.004, eccentricity=0.002, face_width=0.01)
    >>> fitted = cy.Drive(pair).surface.replace(covariance=np.array([[1e-12]]), covariance_of=("eccentricity",))
    >>> drawn = fitting.ensemble(cy.Drive(pair, fitted), count=100)
    >>> bool(0.8e-6 < np.std([one.surface.eccentricity for one in drawn]) < 1.2e-6)
    True
    """
    pair, surface = drive.pair, drive.surface
    if surface.covariance is None:
        raise edge.ArgumentError("drive", "has no covariance of a fit; give what identify found")
    places = scatter_names(pair)
    names = [n for n in surface.covariance_of if n not in places]
    at = [surface.covariance_of.index(n) for n in (*names, *places) if n in surface.covariance_of]
    covariance = surface.covariance[np.ix_(at, at)]
    # Eigenvectors also serve where a displacement has no variance at all.
    values, vectors = np.linalg.eigh(covariance)
    normal = np.random.default_rng(seed).standard_normal((count, values.size))
    shifts = normal * np.sqrt(np.maximum(values, 0.0)) @ vectors.T
    drives: list[Drive] = []
    for number, shift in enumerate(shifts):
        moved = {n: structured_value(pair, surface, n) + s for n, s in zip(names, shift, strict=False)}
        one = with_structured(pair, surface, moved)
        if shift.size > len(names):
            one = with_scatter(pair, one, shift[len(names) :])
        attributes = {**surface.attributes, "ensemble_seed": seed, "ensemble_number": number}
        made = one.replace(covariance=None, covariance_of=(), attributes=attributes)
        drives.append(Drive(pair, made, drive.first_stage))
    return drives
