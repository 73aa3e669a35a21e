"""Sweeps, tolerances, limits and tables of FMUs of a drive with elastic bodies: they are those of its analysis."""

import numpy as np
import pytest
from common import ARCSEC
from test_elastic_drive import SOFT_CRANKS, STIFF

import cycloid_fmu as cy
from cycloid_fmu.analysis import solve
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.fmu import tables
from cycloid_fmu.studies import limits
from cycloid_fmu.studies.tolerance import Study, run

PAIR = SOFT_CRANKS.replace(
    discs=1,
    supports=SOFT_CRANKS.supports.replace(turning_arm=STIFF),
    bodies=SOFT_CRANKS.bodies.replace(carrier=None),
)
TORQUE, ANGLES = 20.0, 12


def analysed(pair, angles=ANGLES):
    return cy.Drive(pair).analyze(TORQUE, angles=angles)


def test_a_sweep_over_a_body_s_modulus_ends_in_the_rigid_drive():
    """With its own modulus it is the drive's analysis, with 1e25 Pa that without bodies."""
    swept = cy.Drive(PAIR).sweep(
        {"bodies.crank.youngs_modulus": ["206 GPa", "1e25 Pa"]}, TORQUE, angles=ANGLES, workers=1
    )
    for number, pair in enumerate((PAIR, PAIR.replace(bodies=None))):
        data, found = analysed(pair), swept.isel({"bodies.crank.youngs_modulus": number})
        error = data.transmission_error.values[0]
        assert found.mean_transmission_error.values[0] == pytest.approx(error.mean(), rel=1e-6)
        assert found.angular_transmission_error.values[0] == pytest.approx(np.ptp(error), rel=1e-5)
        assert found.max_contact_pressure.values[0] == pytest.approx(data.max_contact_pressure.values.max(), rel=1e-6)
    soft, rigid = swept.mean_transmission_error.values[:, 0]
    assert soft > 1.1 * rigid


def test_samples_without_room_for_errors_are_the_drive_as_drawn():
    """Tolerances of 1 fm: every sample has the figures of the analysis."""
    tolerances = cy.Tolerances(eccentricity={"tolerance": 1e-15}, pin_radius={"tolerance": 1e-15})
    found = run(Study(PAIR, tolerances, samples=2, seed=1, torque=(TORQUE,), angles=ANGLES))
    data = analysed(PAIR)
    for name, expected in (
        ("mean_transmission_error", data.transmission_error.values.mean()),
        ("angular_transmission_error", np.ptp(data.transmission_error.values)),
        ("max_contact_pressure", data.max_contact_pressure.values.max()),
    ):
        assert found.figure(name).ravel() == pytest.approx(np.full(2, expected), rel=1e-6), name


def test_limits_judge_the_figures_of_the_analysis():
    """The largest pressure and the least stiffness are those with bodies, which are not those of rigid ones."""
    asked = limits.Requirements(limits={"max_contact_pressure": "900 MPa", "torsional_stiffness": "1 N*m/arcmin"})
    data, rigid = analysed(PAIR), analysed(PAIR.replace(bodies=None))
    found = {one.figure: one.value for one in cy.Drive(PAIR).judge(asked, TORQUE, angles=ANGLES).verdicts}
    assert found["max_contact_pressure"] == pytest.approx(float(data.max_contact_pressure.max()), rel=1e-9)
    assert found["torsional_stiffness"] == pytest.approx(float(data.torsional_stiffness.min()), rel=1e-9)
    assert found["torsional_stiffness"] < 0.95 * float(rigid.torsional_stiffness.min())


def test_tables_of_an_fmu_are_the_analysis_at_their_nodes_and_between(monkeypatch):
    """At the nodes within the step of storage, elsewhere within their accuracy."""
    for name, few in (("PROBES", 100), ("_SPREAD", 30), ("_WORST", 10), ("_SAMPLES", (16, 16, 16))):
        monkeypatch.setattr(tables, name, few)
    drive, accuracy = DriveValue.as_stated(PAIR), 5.0 * ARCSEC
    made = tables.compute(drive, accuracy=accuracy, largest_load=TORQUE)
    nodes = made.period / made.positive.transmission_error.shape[1] * np.arange(0, 40, 13)
    for torque in made.positive.load[[-1, len(made.positive.load) // 2]]:
        for angles, within in ((nodes, 0.2 * accuracy), (nodes + 0.04, accuracy)):
            found = tables.interpolated(made, angles, np.full(angles.size, torque))
            exact = solve(drive, [torque], angles, with_play=False)
            assert np.abs(found.transmission_error - exact.transmission_error[0]).max() < within
    rigid = solve(DriveValue.as_stated(PAIR.replace(bodies=None)), [TORQUE], nodes, with_play=False)
    assert np.abs(rigid.transmission_error[0] - exact.transmission_error[0]).max() > 5.0 * accuracy
