"""The observation model against the drive that a system model steps."""

import dataclasses

import numpy as np
import pytest
from clockworks import kinematic_drive

from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.surfaces.structured import profile_names, with_structured
from cycloid_fmu.surfaces.surface import surface_of_pair
from fitting.estimation.plan import planned_curve
from fitting.model.discrepancy import RIPPLE, causes, ripple_of
from fitting.model.observations import (
    PROFILE_ORDERS,
    Discrepancy,
    State,
    form_columns,
    linearise,
    observations,
    spread_of,
)


@pytest.mark.parametrize("output", ["gear", "ring"])
@pytest.mark.parametrize(("direction", "torque"), [(1, 60.0), (1, -60.0), (-1, 60.0)])
def test_friction_acts_against_the_motion(nominal, output, direction, torque):
    """Dry friction of a drive has the effect of the same friction torque in the fit."""
    pair = nominal.replace(output=output)
    drive = kinematic_drive(DriveValue.as_stated(pair))
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


@pytest.fixture(scope="module")
def rippled(nominal):
    """Observations, a state with a chain, and coefficients of a torque ripple that the sensor does not see."""
    curves = [planned_curve(nominal.ratio, t, int(np.sign(t)), 1.0, 6) for t in (60.0, -60.0, 200.0)]
    observed = observations(curves, nominal, [1e-6] * 3)
    state = State(surface_of_pair(nominal), np.zeros(spread_of(nominal, {}).size), np.zeros(observed.bench.shape[1]))
    state.bench[observed.bench_names.index("chain_compliance")] = 1e-6
    return observed, state, np.array([3.0, -2.0, 1.0, 0.5, -1.0, 2.0]) * 1e-8


def test_a_torque_ripple_acts_on_contacts_as_its_columns_say_and_on_the_chain(nominal, rippled):
    observed, state, coefficients = rippled
    linear = linearise(nominal, observed, state)
    columns = causes(nominal, observed, linear)[RIPPLE]
    ripple = ripple_of(observed, coefficients)
    moved = observed.with_misfit(Discrepancy({}, ripple=ripple))
    difference = linearise(nominal, moved, state).model - linear.model
    assert np.abs(ripple).max() < 1e-2
    assert difference == pytest.approx(columns @ coefficients, abs=1e-2 * np.abs(difference).max())
    in_chain = (moved.bench - observed.bench) @ state.bench
    assert in_chain == pytest.approx(1e-6 * ripple * observed.torque, rel=1e-12)


def test_a_form_s_effect_is_that_of_the_model_where_supports_give_way(nominal):
    """At the displaced supports: elsewhere corners of the curves are at other crank angles."""
    observed = observations([planned_curve(nominal.ratio, 20.0, 1, 1.0, 24)], nominal, [1e-6])
    observed = dataclasses.replace(observed, give=np.array([[2e-6, -1e-6, 1e-6, 5e-3]]))
    surface = with_structured(surface_of_pair(nominal), {"pin_radial_2_cos": 3e-6, "pin_radius": -2e-6})
    state = State(surface, np.zeros(spread_of(nominal, {}).size), np.zeros(observed.bench.shape[1]))
    columns = form_columns(nominal, observed, state, linearise(nominal, observed, state), 1e-6)

    def model(name, size):
        formed = dataclasses.replace(state, surface=with_structured(surface, {name: size}))
        return linearise(nominal, observed, formed).model

    for column, name in zip(columns.T, profile_names(PROFILE_ORDERS), strict=True):
        difference = (model(name, 1e-8) - model(name, -1e-8)) / 2e-8
        away = np.abs(difference - column) > 1e-2 * np.abs(column).max()
        assert away.mean() < 0.02, "but for points in a corner"


def test_parts_of_observations_keep_their_torque_ripple(rippled):
    observed, _, coefficients = rippled
    moved = observed.with_misfit(Discrepancy({}, ripple=ripple_of(observed, coefficients)))
    assert moved.torque == pytest.approx(observed.torque * (1.0 + moved.ripple), rel=1e-15)
    assert moved.some([2]).torque == pytest.approx(moved.torque_of(2), rel=1e-15)
    thin = moved.thinned(60)
    assert 0 < thin.torque.size < moved.torque.size
    assert thin.ripple == pytest.approx(ripple_of(observed.thinned(60), coefficients), rel=1e-12)


def test_a_loop_has_no_torque_ripple(rippled):
    observed, _, coefficients = rippled
    loop = dataclasses.replace(observed.curves[0], branch="loading")
    mixed = dataclasses.replace(observed, curves=(loop, *observed.curves[1:]))
    first, *others = np.split(ripple_of(mixed, coefficients), mixed.ends)
    assert not first.any()
    assert all(one.any() for one in others)
