"""Error surfaces drawn from the distribution of a fit: drives that agree with the measurements."""

from __future__ import annotations

from cycloid_fmu.drive import Drive
from cycloid_fmu.surfaces.posterior import drawn_surfaces


def ensemble(drive: Drive, count: int = 20, seed: int = 0) -> list[Drive]:
    """Draw drives that agree with the measurements as the identified one, from the normal distribution of its fit.

    Parameters
    ----------
    drive
        `Identification.drive`, or another whose surface has the covariance of a fit.
    count, seed
        Number of drives, and the seed; the same seed draws the same drives.

    Returns
    -------
    drives
        Drives without covariance; seed and number are in the attributes of their surfaces.

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

    Threads solve several drives at once, and only the parts that are kept take memory:

    >>> from concurrent.futures import ThreadPoolExecutor
    >>> with ThreadPoolExecutor() as pool:
    ...     solved = pool.map(lambda one: one.analyze([50.0, -50.0], angles=20, workers=1).transmission_error, drawn)
    ...     band = np.ptp(list(solved), axis=0)  # of all drives, at each load and crank angle
    >>> band.shape
    (2, 20)
    """
    drawn = drawn_surfaces(drive.pair, drive.surface, count, seed)
    return [Drive(drive.pair, one, drive.first_stage) for one in drawn]
