"""Exact FMUs of drives with elastic bodies: against `analyze`, their energy, and their resources."""

import functools
import json
import math
import zipfile

import fmpy
import numpy as np
import platformdirs
import pytest
from clockworks import check_restored, compliant_drive, kinematic_drive, torques_of_energy
from test_elastic_drive import CRANKS, ELASTIC, PAIR, PINS, SOFT_CRANKS, STIFF, solved

import cycloid_fmu as cy
from cycloid_fmu.bodies import disc as discs
from cycloid_fmu.bodies.matrices import BodyMatrices, matrices_of, port_matrices
from cycloid_fmu.contact import contact_rows
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.fmu.clockwork import StepError
from cycloid_fmu.fmu.core import Core
from cycloid_fmu.supports.elastic import pin_law
from cycloid_fmu.supports.transmission import assembly_of, problem_of

BENT_PINS = PAIR.replace(
    supports=PAIR.supports.replace(pin_seat={"kind": "half_shell", "clearance": "4 um"}), bodies={"pin": PINS}
)
SOFT_DISCS = CRANKS.replace(
    supports=CRANKS.supports.replace(turning_arm=STIFF), bodies={"disc": {"bore_radius": "6 mm"}}
)
DRIVES = {"cranks": SOFT_CRANKS, "output_rollers": BENT_PINS}


@functools.cache
def drive(name):
    return DriveValue.as_stated(DRIVES[name])


def put(model, crank, deviation):
    model.crank_angle, model.output_angle = crank, crank / model.pair.ratio + deviation


# --- one drive, one energy ---


@pytest.mark.parametrize("name", DRIVES)
def test_the_kinematic_model_is_the_analysis(name):
    model, angles = kinematic_drive(drive(name)), np.array([0.4, 0.43, 3.0, 40.0])
    for torque in (20.0, -8.0):
        wanted = cy.Drive(DRIVES[name]).analyze(torque, crank_angle=angles)
        model.torque = torque
        for i, angle in enumerate(angles):
            model.crank_angle = angle
            model.advance()
            assert model.transmission_error == pytest.approx(wanted.transmission_error.values[0, i], abs=1e-10)
            assert model.backlash == pytest.approx(wanted.backlash.values.ravel()[i], abs=1e-9)
            assert model.torsional_stiffness == pytest.approx(wanted.torsional_stiffness.values[0, i], rel=1e-7)
            # `analyze` has the bearings' forces without the centring springs.
            assert model.crank_torque == pytest.approx(wanted.crank_torque.values[0, i], rel=1e-6)
            assert model.max_contact_pressure == pytest.approx(wanted.max_contact_pressure.values[0, i], rel=1e-6)


def check_energy(model, crank, deviation):
    """Both torques are differences of the stored energy, which is above zero under load."""
    by_crank, by_output = torques_of_energy(model, crank, crank / model.ratio + deviation)
    assert model.crank_torque == pytest.approx(by_crank, rel=1e-5, abs=1e-5)
    assert model.torque == pytest.approx(by_output, rel=1e-5, abs=1e-4)
    assert abs(model.torque) > 3.0
    assert model.elastic_energy > 0.0


@pytest.mark.parametrize("name", DRIVES)
@pytest.mark.parametrize("compliance", [0.0, 5e-6])
def test_both_torques_are_derivatives_of_the_stored_energy(name, compliance):
    model = compliant_drive(drive(name))
    model.series_compliance = compliance
    for crank, deviation in ((0.3, 1.2e-3), (5.5, -9e-4)):
        check_energy(model, crank, deviation)


@pytest.mark.slow(30)
@pytest.mark.parametrize("pair", [ELASTIC, SOFT_DISCS], ids=["output_rollers", "cranks"])
def test_torques_of_elastic_discs_are_derivatives_of_their_energy(pair):
    model = compliant_drive(DriveValue.as_stated(pair))
    for crank, deviation in ((0.3, 1.2e-3), (5.5, -9e-4)):
        check_energy(model, crank, deviation)


@pytest.mark.parametrize("shell", [math.nan, 0.0, 4e-6])
@pytest.mark.parametrize("patch", [0.0, 1e-3])
def test_a_pin_s_energy_is_the_work_of_its_force(shell, patch):
    """dW/dF = F dδ/dF, and at the same δ dW/dκ is what W(F, κ) and δ(F, κ) give; also along the tangent."""
    seat = {"stiffness_per_width": "30 GPa"} if math.isnan(shell) else {"kind": "half_shell", "clearance": shell}
    value = DriveValue.as_stated(PAIR.replace(supports=PAIR.supports.replace(pin_seat=seat), bodies={"pin": PINS}))
    problem, elastic = problem_of(value), assembly_of(value).elastic._replace(patch_half_width=patch)
    contact = contact_rows(problem)[0]
    curvature, limit = 120.0, 0.75 * 1e-3
    wide = 0.25 * limit**2 * (250.0 + curvature) * math.pi * 0.01
    wide /= problem.compliance_gear + problem.compliance_pin
    for force in (200.0, 3.0 * wide):

        def law(force, curvature=curvature):
            contact.curvature = curvature
            return pin_law(problem, elastic, contact, 0, force)

        step, bend = 1e-4 * force, 1e-3
        low, high, here = law(force - step), law(force + step), law(force)
        softness = (high.approach - low.approach) / (2.0 * step)
        assert here.softness == pytest.approx(softness, rel=1e-6)
        assert (high.energy - low.energy) / (2.0 * step) == pytest.approx(force * softness, rel=1e-6)
        low, high = law(force, curvature - bend), law(force, curvature + bend)
        bent = (high.approach - low.approach) / (2.0 * bend)
        assert here.bent == pytest.approx(bent, rel=1e-5)
        by_curvature = (high.energy - low.energy) / (2.0 * bend)
        assert here.bent_energy == pytest.approx(by_curvature - force * bent, rel=1e-4)


def test_bodies_without_compliance_are_rigid_ones():
    stiff = {"pin": {"ends": "supported", "span": "26 mm", "youngs_modulus": 1e25}}
    soft, rigid = (kinematic_drive(DriveValue.as_stated(CRANKS.replace(bodies=each))) for each in (stiff, None))
    pressed, free = (compliant_drive(DriveValue.as_stated(CRANKS.replace(bodies=each))) for each in (stiff, None))
    for crank, torque in ((0.4, 20.0), (1.9, -10.0)):
        for model in (soft, rigid):
            model.crank_angle, model.torque = crank, torque
            model.advance()
        assert soft.transmission_error == pytest.approx(rigid.transmission_error, rel=1e-6)
        # With elastic bodies the flank's curvature is held in the stiffness.
        assert soft.torsional_stiffness == pytest.approx(rigid.torsional_stiffness, rel=1e-4)
        assert soft.crank_torque == pytest.approx(rigid.crank_torque, rel=1e-6)
        for model in (pressed, free):
            put(model, crank, rigid.transmission_error)
        assert pressed.torque == pytest.approx(free.torque, rel=1e-6)
        assert pressed.elastic_energy == pytest.approx(free.elastic_energy, rel=1e-6)


# --- the model in time ---


@pytest.mark.parametrize("name", DRIVES)
def test_a_state_restores_exactly_also_in_another_instance(name):
    model, other = kinematic_drive(drive(name)), kinematic_drive(drive(name))
    model.friction_torque = 1.0
    check_restored(model, other, 8, 20.0)


def test_a_refused_step_changes_nothing():
    """Also one that was solved before it was refused."""
    model = compliant_drive(drive("cranks"))
    put(model, 0.3, 1.2e-3)
    model.advance(1e-3)
    before = model.state()
    with pytest.raises(StepError, match="finite"):
        model.advance(math.nan)
    assert model.state() == before
    put(model, 0.4, 1.0)
    moved = model.state()
    with pytest.raises(StepError, match="must stay within"):
        model.advance(1e-3)
    assert model.state() == moved


# --- the file ---


def resources(built, folder):
    with zipfile.ZipFile(built) as archive:
        archive.extractall(folder)
    return folder / "resources"


@pytest.mark.slow(20)
@pytest.mark.parametrize("pair", [SOFT_CRANKS, SOFT_DISCS], ids=["cranks", "discs"])
def test_a_built_fmu_is_what_analyze_says(pair, tmp_path):
    cy.Drive(pair).build_fmu(tmp_path / "drive.fmu")
    time = np.arange(12) * 0.01
    motion = np.array(
        [(t, 20.0 * t, 15.0) for t in time], [("time", float), ("flange_a.phi", float), ("flange_b.tau", float)]
    )
    found = fmpy.simulate_fmu(
        str(tmp_path / "drive.fmu"),
        stop_time=time[-1],
        step_size=0.01,
        input=motion,
        output=["flange_a.phi", "transmission_error", "flange_a.tau", "torsional_stiffness"],
    )
    wanted = cy.Drive(pair).analyze(15.0, crank_angle=found["flange_a.phi"])
    assert found["transmission_error"] == pytest.approx(wanted.transmission_error.values[0], abs=1e-9)
    assert found["torsional_stiffness"] == pytest.approx(wanted.torsional_stiffness.values[0], rel=1e-6)
    assert found["flange_a.tau"] == pytest.approx(wanted.crank_torque.values[0], rel=1e-6)


@pytest.mark.slow(5)
def test_an_fmu_has_the_matrices_of_its_bodies_and_computes_none(tmp_path, monkeypatch):
    """It is the drive where scikit-fem and the files that the pair names are missing, and refuses damaged matrices."""
    cy.Drive(SOFT_DISCS).build_fmu(tmp_path / "drive.fmu")
    cy.Drive(SOFT_DISCS).build_fmu(tmp_path / "again.fmu")
    assert (tmp_path / "drive.fmu").read_bytes() == (tmp_path / "again.fmu").read_bytes()
    folder = resources(tmp_path / "drive.fmu", tmp_path / "fmu")
    names = [f"influence-disc-{disc}.nc" for disc in range(2)]
    assert json.loads((folder / "pair.json").read_text())["influence"] == {"disc": names}
    wanted = solved(SOFT_DISCS, 15.0, np.array([0.3])).transmission_error[0, 0]
    monkeypatch.setattr(platformdirs, "user_cache_dir", lambda *words, **options: str(tmp_path / "cache"))
    monkeypatch.setattr(discs, "condensed", None)
    core = Core(folder, "2.0")
    model = {variable.name: reference for reference, variable in core.table.items()}
    core.clockwork.put(model["flange_a.phi"], 0.3)
    core.clockwork.put(model["flange_b.tau"], 15.0)
    core.clockwork.start()
    assert core.clockwork.value(model["transmission_error"]) == pytest.approx(wanted, abs=1e-10)
    damaged = folder / names[1]
    damaged.write_bytes(damaged.read_bytes()[:-1] + b"x")
    with pytest.raises(RuntimeError, match=r"influence-disc-1\.nc: it is damaged"):
        Core(folder, "2.0")


def test_matrices_in_files_are_those_of_the_bodies(tmp_path):
    """All bodies but discs: each written with its ports and read instead of computed."""
    from cycloid_fmu.bodies.given import write_influence

    for pair in (SOFT_CRANKS, ELASTIC.replace(bodies=ELASTIC.bodies.replace(disc=None))):
        computed = matrices_of(pair, pair.bodies)
        files = {}
        for name, each in port_matrices(computed).items():
            files[name] = [str(tmp_path / f"{name}.nc")]
            write_influence(each[0], files[name][0])
        assert set(files) == {name for name, _ in pair.bodies.stated()}
        read = matrices_of(pair, pair.bodies.of_files(files))
        for name in files:
            assert np.array_equal(getattr(read, name), getattr(computed, name)), name
    assert port_matrices(BodyMatrices()) == {}
