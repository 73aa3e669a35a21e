"""The observation model against the drive that a system model steps."""

import dataclasses

import numpy as np
import pytest

from cycloid_fmu.fmu.model import DriveModel
from cycloid_fmu.surfaces.surface import surface_of_pair
from fitting.estimation.plan import planned_curve
from fitting.model.observations import State, linearise, observations, spread_of


@pytest.mark.parametrize("output", ["gear", "ring"])
@pytest.mark.parametrize(("direction", "torque"), [(1, 60.0), (1, -60.0), (-1, 60.0)])
def test_friction_acts_against_the_motion(nominal, output, direction, torque):
    """Dry friction of a drive has the effect of the same friction torque in the fit."""
    pair = nominal.replace(output=output)
    drive = DriveModel(pair, surface_of_pair(pair))
    drive.friction_torque, drive.torque = 5.0, torque
    errors, angles = [], 10.0 + direction * np.arange(6) * 0.3
    for angle in (10.0 - direction * 0.3, *angles):  # from the first on the lost motion is passed through
        drive.crank_angle = float(angle)
        drive.advance()
        errors.append(drive.transmission_error)
    curve = dataclasses.replace(planned_curve(pair.ratio, torque, direction, 6 / 39 / 100, 100), input_angle=angles)
    observed = observations([curve], pair, [1e-6])
    state = State(
        surface_of_pair(pair), np.zeros(spread_of(pair, {}).size), np.zeros(observed.bench.shape[1]), friction=5.0
    )
    linear, more = (linearise(pair, observed, dataclasses.replace(state, friction=f)) for f in (5.0, 5.01))
    assert linear.model == pytest.approx(errors[1:], abs=1e-10)
    assert linear.by_friction == pytest.approx((more.model - linear.model) / 0.01, rel=1e-2)
