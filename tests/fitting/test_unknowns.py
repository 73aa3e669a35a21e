"""The table of unknowns: a vector goes into a state and out again, and every one has a name, a unit and bounds."""

import numpy as np
import pytest
from test_bearings import cranked

from cycloid_fmu.geometry.first_stage import FirstStage
from fitting.estimation.plan import planned_curve
from fitting.model.loops import planned_branches
from fitting.model.observations import errors_of, linearise, observations
from fitting.model.unknowns import UNKNOWN, Unknowns


@pytest.fixture(params=["rigid", "bearings", "first stage and loops"])
def table(request):
    pair = cranked(2) if request.param == "bearings" else cranked(1).replace(supports=None)
    stage = FirstStage(18, 54, 0.0, 0.0) if request.param.startswith("first") else None
    curves = [planned_curve(pair.ratio, t, int(np.sign(t)), 0.3, 8) for t in (60.0, -200.0)]
    curves += planned_branches(pair, 100.0, 0.0, 0) if stage else []
    observed = observations(curves, pair, [1e-6] * len(curves), first_stage=stage)
    return pair, observed, Unknowns(pair, observed, errors_of(pair))


def test_a_vector_goes_into_a_state_and_out_again(table):
    _, _, unknowns = table
    vector = np.random.default_rng(0).normal(0.0, 0.2, len(unknowns.names))
    again = unknowns.vector(unknowns.state(vector))
    assert again == pytest.approx(vector, abs=1e-9)


def test_each_unknown_stands_once_in_the_table_with_all_that_belongs_to_it(table):
    pair, observed, unknowns = table
    size = len(unknowns.names)
    assert len(set(unknowns.names)) == size == len(unknowns.units) == unknowns.scale.size == unknowns.low.size
    ends = [part for one in (unknowns.errors, unknowns.nuisances, unknowns.scatter) for part in (one.start, one.stop)]
    assert ends == [0, len(errors_of(pair)), len(errors_of(pair)), unknowns.scatter.start, unknowns.scatter.start, size]
    assert unknowns.names[unknowns.bearings] == [*observed.bearing_names]
    assert set(unknowns.units) <= {"m", "rad", "1", "N*m", "rad/(N*m)"}
    assert (unknowns.low < unknowns.high).all()
    assert (unknowns.scale > 0.0).all()
    precision = unknowns.precision({"pin_radial": 2e-6})
    part = unknowns.parts["pin_radial"]
    assert (unknowns.scale[part] / np.sqrt(precision[part])) == pytest.approx(2e-6)
    assert precision[unknowns.errors] == pytest.approx(UNKNOWN)


def test_columns_are_differences_of_the_model_in_units_of_the_noise(table):
    pair, observed, unknowns = table
    zero = np.zeros(len(unknowns.names))
    zero[[unknowns.names.index(n) for n in observed.bearing_names]] = 0.1
    state = unknowns.state(zero)
    columns = unknowns.columns(observed, linearise(pair, observed, state))

    def modelled(vector):
        there = unknowns.state(vector)
        return observed.weight * (linearise(pair, observed, there).model + observed.bench @ there.bench)

    for name in ("pin_radius", "chain_compliance", "friction_torque", *observed.bearing_names[:2], "pin_radial_at_3"):
        at, step = unknowns.names.index(name), np.zeros(zero.size)
        step[at] = 1e-3
        slope = (modelled(zero + step) - modelled(zero - step)) / 2e-3
        # Where a contact opens within the step the difference is not the derivative.
        away = np.abs(columns[:, at] - slope) / max(float(np.abs(slope).max()), 1e-9)
        assert np.median(away) < 1e-3, name
