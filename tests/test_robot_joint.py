"""The robot joint's FMU against the stiff solver, and where its energy goes."""

import sys

import numpy as np
import pytest
from common import EXAMPLES


@pytest.fixture(scope="module")
def example():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(EXAMPLES)
        import robot_joint

        yield robot_joint
    sys.modules.pop("robot_joint", None)


@pytest.fixture(scope="module")
def to_and_fro(example, tmp_path_factory):
    """Both runs of the whole way."""
    return compared(example, tmp_path_factory.mktemp("whole"))


@pytest.fixture(scope="module")
def there(example, tmp_path_factory):
    """Both runs of the first half of the way, until the arm has swung three times."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(example, "END", example.MOVE + 0.04)
        return compared(example, tmp_path_factory.mktemp("half"))


def compared(example, folder):
    with pytest.warns(UserWarning, match=r"rv-20e.toml: \[stated\]"):
        return example.compared(folder)


@pytest.mark.parametrize("way", ["there", pytest.param("to_and_fro", marks=pytest.mark.slow(15))])
def test_the_arm_swings_and_is_loaded_as_the_stiff_solver_has_it(example, request, way):
    joint, exact, _, _ = request.getfixturevalue(way)
    assert joint.resonance == pytest.approx(exact.resonance, rel=0.01)
    assert np.abs(joint.on_arm).max() == pytest.approx(np.abs(exact.on_arm).max(), rel=0.02)
    assert np.abs(joint.on_arm - exact.on_arm).max() < 0.05 * np.abs(exact.on_arm).max()
    # The way leads through reversals of torque and the play, and is nearly the wanted one.
    assert exact.on_arm.min() < -50.0
    there = exact.time.searchsorted(example.MOVE)
    assert exact.arm[there] == pytest.approx(example.WAY, abs=2e-3)


def test_work_done_moves_is_stored_or_lost_and_the_cold_takes_more(there):
    _, _, (done, kinetic, elastic, lost, passed), cold = there
    assert passed[-1] > 30.0
    assert np.abs(done - kinetic - elastic - lost).max() < 1e-7 * passed[-1]
    assert (np.diff(lost) >= -1e-12).all()
    # Between 10 and 40 °C the motor's friction goes with exp(-0.015/K · 30 K), the arm's stays.
    assert 1.0 < cold[3, -1] / lost[-1] < np.exp(0.45)
