"""The robot joint's FMU against the stiff solver, and where its energy goes."""

import sys
import warnings

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
def runs(example, tmp_path_factory):
    """Runs of joint and reference to a time, and the joint's FMU."""
    folder = tmp_path_factory.mktemp("joint")

    def to(end):
        with pytest.MonkeyPatch.context() as patch, warnings.catch_warnings():
            # The reducer's file contradicts itself, as its paper does.
            warnings.simplefilter("ignore", UserWarning)
            patch.setattr(example, "END", end)
            return (*example.compared(folder)[:2], folder / "joint.fmu")

    return to


def test_the_first_swing_is_that_of_the_stiff_solver(runs):
    """The drive takes up the arm: largest torque, and all the way to it."""
    joint, exact, _ = runs(0.03)
    assert np.abs(exact.on_arm).max() > 150.0
    assert np.abs(joint.on_arm).max() == pytest.approx(np.abs(exact.on_arm).max(), rel=0.02)
    assert joint.on_arm == pytest.approx(exact.on_arm, abs=1.0)


@pytest.mark.slow(15)
def test_to_and_fro_the_joint_swings_and_is_loaded_as_the_stiff_solver_has_it(example, runs):
    joint, exact, _ = runs(example.END)
    assert joint.resonance == pytest.approx(exact.resonance, rel=0.01)
    assert np.abs(joint.on_arm).max() == pytest.approx(np.abs(exact.on_arm).max(), rel=0.02)
    assert joint.arm == pytest.approx(exact.arm, abs=2.0 * example.cy.ARCSEC)
    # The way leads through reversals of torque and the play, and is nearly the wanted one.
    assert exact.on_arm.min() < -50.0
    assert exact.arm.max() == pytest.approx(example.WAY, abs=2e-3)


@pytest.mark.slow(4)
def test_work_done_moves_is_stored_or_lost_and_the_cold_takes_more(example, runs):
    _, _, fmu = runs(example.STEP)
    warm, cold = (example.moved(fmu, 141.0, temperature)[1] for temperature in (example.WARM, example.COLD))
    done, kinetic, elastic, lost, passed = warm
    assert passed[-1] > 50.0
    assert np.abs(done - kinetic - elastic - lost).max() < 1e-7 * passed[-1]
    assert (np.diff(lost) >= -1e-12).all()
    # Between 10 and 40 °C the motor's friction goes with exp(-0.015/K · 30 K), the arm's stays.
    assert 1.0 < cold[3, -1] / lost[-1] < np.exp(0.45)
