"""Rooms that take a drive with elastic bodies: friction, heat and files."""

import numpy as np
import pytest
from common import EXAMPLES
from test_elastic_drive import ANGLES, CRANKS, ELASTIC, PAIR, SOFT_CRANKS, STIFF, solved

import cycloid_fmu as cy
from cycloid_fmu import edge
from cycloid_fmu.analysis import solve
from cycloid_fmu.bodies import outline
from cycloid_fmu.bodies.disc import SECTORS, elastic_disc, nodal_forces
from cycloid_fmu.bodies.matrices import matrices_of
from cycloid_fmu.desk.view import look, open_desk
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.geometry.losses import PARTS
from cycloid_fmu.geometry.pair import read_pair, write_pair
from cycloid_fmu.losses.heat import Running, at_oil_temperature, heat
from cycloid_fmu.losses.sensitivity import motion_sensitivity, sensitivity
from cycloid_fmu.losses.solver import solve as rub
from cycloid_fmu.supports.disc_forces import disc_forces
from cycloid_fmu.supports.figures import remaining
from cycloid_fmu.supports.transmission import parameters_of
from cycloid_fmu.surfaces.structured import displacement_layout

SPEED = 10.0
BEARINGS = {
    name: {"radius": radius, "friction_coefficient": 0.02}
    for name, radius in (("turning_arm", "8 mm"), ("crank_shaft", "6 mm"), ("main", "20 mm"))
}
FIXED_PINS = {"flank": {"friction_coefficient": 0.06}, **BEARINGS}
SLEEVES = {
    **FIXED_PINS,
    "pin": {"radius": "2 mm", "friction_coefficient": 0.07},
    "output_contact": {"friction_coefficient": 0.08},
    "output_roller": {"outer_radius": "5 mm", "radius": "4 mm", "friction_coefficient": 0.07},
}
RUBBING = {"output_rollers": ELASTIC.replace(losses=SLEEVES), "cranks": SOFT_CRANKS.replace(losses=FIXED_PINS)}


def rubbed(pair, direction=1, torque=20.0, angles=ANGLES):
    return rub(DriveValue.as_stated(pair), np.array([torque]), angles, direction, SPEED)


# --- friction ---


@pytest.mark.parametrize("name", RUBBING)
def test_without_friction_losses_are_the_analysis(name):
    pair = RUBBING[name].replace(losses={"flank": {"friction_coefficient": 0.0}})
    found, expected = rubbed(pair), solved(pair)
    assert found.crank_torque == pytest.approx(expected.crank_torque, rel=1e-12)
    assert found.motion.transmission_error == pytest.approx(expected.transmission_error, rel=1e-12)
    assert found.motion.compliance == pytest.approx(expected.compliance, rel=1e-12)


@pytest.mark.parametrize("name", RUBBING)
def test_power_in_is_power_out_and_heat(name):
    """Over whole turns of the disc, in both directions."""
    pair = RUBBING[name]
    angles, output = np.arange(45) / 45 * 2.0 * np.pi * pair.gear_teeth, 20.0 / pair.gear_teeth
    for direction in (1, -1):
        found = rubbed(pair, direction, angles=angles)
        heat = found.loss.sum(axis=-1).mean()
        assert heat > 0.05 * output
        assert direction * (found.crank_torque.mean() - output) == pytest.approx(heat, abs=1e-3 * output)


def test_friction_on_bodies_without_compliance_is_that_of_rigid_bodies():
    stiff = {"pin": {"ends": "supported", "span": "16 mm", "youngs_modulus": 1e25}}
    pair = PAIR.replace(losses=SLEEVES)
    for direction in (1, -1):
        elastic, rigid = rubbed(pair.replace(bodies=stiff), direction), rubbed(pair, direction)
        assert elastic.crank_torque == pytest.approx(rigid.crank_torque, rel=1e-6)
        assert elastic.motion.transmission_error == pytest.approx(rigid.motion.transmission_error, rel=1e-6)
        assert elastic.loss == pytest.approx(rigid.loss, rel=1e-5, abs=1e-9)


def test_bearings_of_elastic_bodies_rub_as_their_forces_do():
    """A plain bearing's loss is μ r F for each radian that it turns: with the forces that elastic bodies give it."""
    found = rubbed(RUBBING["cranks"])
    relative = 1.0 + 1.0 / SOFT_CRANKS.gear_teeth
    by_force = 0.02 * 8e-3 * relative * found.motion.turning_arm_force.sum(axis=(-1, -2))
    assert found.loss[..., PARTS.index("turning_arm")] == pytest.approx(by_force, rel=1e-9)


@pytest.mark.parametrize("name", RUBBING)
def test_derivatives_with_friction_are_differences(name):
    """Of the transmission error and the crank's torque: by errors, torque, angle, bearings and coefficients."""
    pair = RUBBING[name]
    drive, layout = DriveValue.as_stated(pair), displacement_layout(pair)
    found, of_torque = motion_sensitivity(drive, 20.0, ANGLES, 1, SPEED), sensitivity(drive, rubbed(pair))

    def differs(derivative, moved, step):
        high, low = moved(step), moved(-step)
        expected = (high.motion.transmission_error - low.motion.transmission_error)[0] / (2.0 * step)
        return np.abs(derivative - expected).max() / np.abs(expected).max()

    for pin in (4, 8):
        for key in ("pin_radial", "pin_tangential"):

            def with_error(d, key=key, pin=pin):
                return rubbed(pair.replace(errors={key: [d * (n == pin) for n in range(pair.pins)]}))

            column = found.motion.by_displacement[:, layout[key].start + pin]
            assert differs(column, with_error, 2e-8) < 1e-3, key
    assert differs(found.motion.by_torque, lambda d: rubbed(pair, torque=20.0 + d), 2e-3) < 1e-3
    assert differs(found.motion.by_crank_angle, lambda d: rubbed(pair, angles=ANGLES + d), 1e-4) < 1e-3
    for key, derivative in found.by_coefficient.items():
        part, coefficient = key.split(".")
        table = getattr(pair.losses, part)
        if not (value := getattr(table, coefficient, None)) or not np.abs(of_torque[key]).max() > 0.0:
            continue

        def with_coefficient(d, part=part, coefficient=coefficient, table=table, value=value):
            return rubbed(pair.replace(losses=pair.losses.replace(**{part: table.replace(**{coefficient: value + d})})))

        step = 1e-3 * value
        by = (with_coefficient(step).crank_torque - with_coefficient(-step).crank_torque)[0] / (2.0 * step)
        assert of_torque[key] == pytest.approx(by, rel=1e-3), key
        if np.abs(derivative).max() > 0.0:
            assert differs(derivative, with_coefficient, step) < 1e-3, key


@pytest.mark.parametrize("name", RUBBING)
def test_derivatives_with_friction_by_the_stiffness_of_bodies_are_differences(name):
    pair, step = RUBBING[name], 1e-3
    found = motion_sensitivity(DriveValue.as_stated(pair), 20.0, ANGLES, 1, SPEED).motion.by_bearing
    for body, _ in pair.bodies.stated():
        high, low = (
            rubbed(pair.replace(bodies=pair.bodies.with_factors({body: np.exp(way * step)}))).motion.transmission_error
            for way in (1.0, -1.0)
        )
        column = found[:, parameters_of(pair).index(f"{body}_stiffness")]
        assert (high - low)[0] / (2.0 * step) == pytest.approx(column, rel=2e-3), body


def test_a_warm_drive_gives_off_the_heat_of_its_elastic_bodies():
    """At the steady temperature P = (T - T_0)/R, with the losses solved there once more; they are not rigid bodies'."""
    pair = RUBBING["output_rollers"].replace(thermal={"resistance": "0.9 K/W", "ambient": "20 degC"})
    angles = np.arange(9) / 9 * 2.0 * np.pi * pair.gear_teeth
    warm = heat(DriveValue.as_stated(pair), [Running(20.0, 30.0)], angles)
    there = at_oil_temperature(DriveValue.as_stated(pair), warm.oil)
    power = 30.0 * rub(there, np.array([20.0]), angles, 1, 30.0).loss.sum(axis=-1).mean()
    assert (warm.oil - 293.15) / 0.9 == pytest.approx(power, rel=1e-4)
    rigid = heat(DriveValue.as_stated(pair.replace(bodies=None)), [Running(20.0, 30.0)], angles)
    assert abs(warm.power - rigid.power) > 1e-3 * rigid.power


# --- files ---


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with a pair file and a reducer file that state the matrix of the cranks by its name in this folder."""
    made = tmp_path_factory.mktemp("drive")
    compliance = matrices_of(SOFT_CRANKS, SOFT_CRANKS.bodies).crank
    ports = ["plane:0:0:0:1:0", "plane:1:0:0:1:0"]
    rows = [",".join([port, *map(repr, line.tolist())]) for port, line in zip(ports, compliance, strict=True)]
    (made / "crank.csv").write_text("\n".join([",".join(["held", *ports]), *rows]) + "\n")
    by_file = SOFT_CRANKS.bodies.replace(crank={"matrix": "crank.csv"})
    text = SOFT_CRANKS.replace(bodies=by_file, losses=FIXED_PINS).text
    (made / "pair.toml").write_text(text)
    (made / "pair-without-losses.toml").write_text(SOFT_CRANKS.replace(bodies=by_file).text)
    involute = '[involute]\nsun_teeth = 12\nplanet_teeth = 24\nmodule = "1.1111111111 mm"\nface_width = "6 mm"\n'
    reducer = text.replace("cycloid-pair/1", "cycloid-reducer/1") + involute
    (made / "reducer.toml").write_text(reducer)
    return made


@pytest.mark.parametrize("name", ["pair.toml", "reducer.toml"])
def test_file_names_are_relative_to_the_file_that_states_them(folder, name, monkeypatch, tmp_path):
    """Read from another folder, the matrix gives the drive whose crank it was computed of."""
    monkeypatch.chdir(tmp_path)
    drive = cy.read_drive(folder / name)
    found = solve(drive.stage, [20.0], ANGLES, with_play=False)
    assert found.transmission_error == pytest.approx(solved(SOFT_CRANKS).transmission_error, rel=1e-9)


def test_a_pair_in_another_folder_states_the_files_as_seen_from_there(folder, monkeypatch, tmp_path):
    monkeypatch.chdir(folder)
    pair = read_pair("pair.toml")
    for there in (folder / "inside", tmp_path):
        there.mkdir(exist_ok=True)
        write_pair(pair, there / "written.toml")
        again = read_pair(there / "written.toml")
        assert solved(again).transmission_error == pytest.approx(solved(pair).transmission_error, rel=1e-12)
    write_pair(pair, "inside/written.toml")
    assert read_pair("inside/written.toml") == pair
    assert 'matrix = "../crank.csv"' in (folder / "inside" / "written.toml").read_text()


@pytest.mark.parametrize("name", ["pair-without-losses.toml", pytest.param("pair.toml", marks=pytest.mark.slow(20))])
def test_a_desk_reads_file_names_beside_its_pair(folder, monkeypatch, tmp_path, name):
    """With losses it looks for the torque that drives the drive back, which takes most of the time."""
    monkeypatch.chdir(tmp_path)
    assert {"[bodies]", "[losses]"} <= set(open_desk(folder / "pair.toml").kept)
    desk = open_desk(folder / name)
    assert not [key for key in desk.values if key in ("pair.bodies", "pair.losses", "pair.thermal")]
    assert "[bodies]" in desk.kept
    view = look(desk, {**desk.values, "torque": "20 N*m"})
    assert not view.problems
    expected = cy.read_drive(folder / name).analyze(20.0, crank_angle=view.crank_angle)
    assert view.transmission_error == pytest.approx(expected.transmission_error.values[0], rel=1e-9)


def test_a_first_stage_passes_the_torque_of_elastic_bodies(folder):
    """Mean input torque times the ratio is the output's torque but for the losses (docs/theory/losses.md)."""
    drive = cy.read_drive(folder / "reducer.toml")
    angles = np.arange(27) / 27 * 2.0 * np.pi * drive.pair.gear_teeth
    found = rub(drive, np.array([20.0]), angles, 1, SPEED)
    heat_ = found.loss.sum(axis=-1).mean()
    assert found.input_work[0] == pytest.approx(20.0 / drive.pair.gear_teeth + heat_, rel=2e-3)


# --- held against drives ---


@pytest.mark.slow(60)
def test_stiffness_of_the_example_is_the_theory_page_s():
    """Every number of the page's table, with the remainder to the catalogue's stiffness."""
    page = (EXAMPLES.parent / "docs" / "theory" / "bodies.md").read_text(encoding="utf-8")
    lines = page.split("| with one part more")[1].splitlines()
    rows = [[cell.strip() for cell in line.split("|")] for line in lines[2:] if line.startswith("|")]
    drive, arcmin = cy.read_drive(EXAMPLES / "rv-20e-bodies.toml"), edge.unit_scale("N*m/arcmin", "N*m/rad")
    shares, catalogue = drive.compliance(), drive.pair.supports.catalogue_stiffness
    each = [one.compliance for one in shares]
    stiffness = [f"{1.0 / soft / arcmin:.0f}" for soft in np.cumsum(each)]
    each += [remaining(drive.pair.supports, shares), 1.0 / catalogue]
    expected = [f"{soft * 1e6:.3f}" for soft in each]
    assert [row[2] for row in rows[: len(each)]] == [*stiffness, "–", "49"]
    assert [row[3] for row in rows[: len(each)]] == expected
    assert [row[4] for row in rows[: len(each) - 1]] == [f"{s * catalogue:.1%}".replace("%", " %") for s in each[:-1]]
    assert 0.45 < 1.0 - each[-2] * catalogue < 0.5  # about half, and without bodies 28 %


# --- pictures ---


@pytest.mark.slow(20)
@pytest.mark.parametrize("arms", ["stiffness", "rollers"])
def test_a_disc_s_forces_balance_and_do_twice_its_energy(arms):
    """Reciprocity of what is drawn and of the influence in the equilibrium: u·F of the nodes is fᵀC f of the ports."""
    supports = CRANKS.supports if arms == "rollers" else CRANKS.supports.replace(turning_arm=STIFF)
    pair = CRANKS.replace(supports=supports, bodies={"disc": {"bore_radius": "6 mm"}})
    body, angle = pair.bodies.disc, 1.1
    forces = disc_forces(DriveValue.as_stated(pair), 20.0, angle)
    expected = solve(DriveValue.as_stated(pair), [20.0], [angle], with_play=False)
    assert forces.pin == pytest.approx(expected.pin_force[0, 0, 0], rel=1e-9)
    along = np.exp(2j * np.pi * np.arange(SECTORS) / SECTORS) if arms == "rollers" else np.array([1.0, 1j])
    assert np.abs(forces.arm @ along) == pytest.approx(expected.turning_arm_force[0, 0, 0], rel=1e-9)
    flank, normal = outline.flank_at(pair, 0, 2.0 * np.pi * np.arange(10) / 10 + angle / 9)
    total = (-normal * forces.pin).sum() + (forces.arm @ along).sum()
    assert abs(total) < 2e-3 * forces.pin.sum()
    moment = (np.conj(flank) * -normal * forces.pin).imag.sum()
    assert moment == pytest.approx(-0.5 * 20.0, rel=0.1)
    elastic = elastic_disc(pair, body, 0)
    nodal = nodal_forces(elastic, pair, body, 0, angle, forces)
    between = matrices_of(pair, pair.bodies).discs[0].at(angle, "sector" if arms == "rollers" else "bore")
    of_ports = np.concatenate([forces.pin, forces.arm.ravel()])
    assert nodal @ elastic.displacement(nodal[:, None])[:, 0] == pytest.approx(of_ports @ between @ of_ports, rel=5e-3)


def test_forces_on_a_rigid_disc_are_refused():
    with pytest.raises(edge.InputError, match=r"no \[bodies.disc\]"):
        disc_forces(DriveValue.as_stated(SOFT_CRANKS), 20.0, 0.3)
