"""Shares of the parts in the compliance of a drive as drawn, and what a catalogue's stiffness leaves for others."""

from __future__ import annotations

import functools
from collections.abc import Callable

from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.geometry.first_stage import FirstStage, sun_locked_share
from cycloid_fmu.geometry.pair import LOST_MOTION_LOAD, Pair
from cycloid_fmu.supports.figures import Share, remaining
from cycloid_fmu.supports.figures import compliance as of_bearings


def compliance(drive: DriveValue, *, progress: Callable[[int], None] = lambda parts: None) -> list[Share]:
    """Return the shares of compliance and lost motion of a drive as drawn, as `supports.figures.compliance`.

    Behind a first stage each part's share is that with the sun locked, and the first stage has its own.
    """
    return _compliance(drive.pair, drive.first_stage, progress)


def _compliance(pair: Pair, first_stage: FirstStage | None, progress: Callable[[int], None]) -> list[Share]:
    if first_stage is None or pair.rated_torque is None:
        return of_bearings(pair, progress=progress)
    teeth = pair.gear_teeth
    s = sun_locked_share(first_stage.crank_share, teeth)
    # The cranks take their share of the output's torque, in parallel to the stage.
    shares = of_bearings(pair.replace(rated_torque=s * pair.rated_torque), progress=progress)
    soft = (s / teeth) ** 2 / first_stage.crank_stiffness
    play = s * (first_stage.crank_play / teeth + first_stage.bearing_play)
    first = Share("first stage", soft, play + 2.0 * LOST_MOTION_LOAD * pair.rated_torque * soft)
    return [*(Share(one.part, s * s * one.compliance, s * one.lost_motion) for one in shares), first]


def series_compliance(drive: DriveValue) -> float:
    """Return the compliance of the parts that the model takes as rigid, from a stated catalogue stiffness, rad/(N·m).

    It is the catalogue's compliance less that of the drive as drawn (`compliance`): the same for a drive with errors.
    It is 0 without a catalogue stiffness, and where the drive as drawn is softer than that.

    Raises
    ------
    edge.InputError
        As `supports.figures.compliance`.
    """
    supports = drive.pair.supports
    if supports is None or supports.catalogue_stiffness is None:
        return 0.0
    return _left_for_rigid_parts(drive.pair.nominal, drive.first_stage)


@functools.lru_cache(maxsize=16)
def _left_for_rigid_parts(pair: Pair, first_stage: FirstStage | None) -> float:
    assert pair.supports is not None
    return max(remaining(pair.supports, _compliance(pair, first_stage, lambda parts: None)), 0.0)
