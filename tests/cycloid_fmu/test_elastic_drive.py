"""A drive with elastic bodies: an independent solver, limits that must hold, and what refuses bodies."""

import json
import math

import elastic_equilibrium
import numpy as np
import pytest
from test_bodies import CASES, SMALL

import cycloid_fmu as cy
from cycloid_fmu.analysis import sensitivity, solve
from cycloid_fmu.bodies.matrices import BodyMatrices, matrices_of
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.geometry.pair import parse_pair
from cycloid_fmu.supports.transmission import LAWS, PARTS, parameters_of
from cycloid_fmu.surfaces.structured import displacement_layout

STIFF = {"stiffness": "200 N/um"}
BEARINGS = {"turning_arm": STIFF, "crank_shaft": STIFF, "main": {"stiffness": "800 N/um"}}
PAIR = SMALL.replace(
    rated_torque="20 N*m",
    isometric="-10 um",
    offset="-15 um",
    supports=SMALL.supports.replace(**BEARINGS, output_roller={"stiffness": "80 N/um", "clearance": "2 um"}),
)
DISC = {"bore_radius": "10 mm", "roller_hole_radius": "6 mm"}
PINS = {"ends": "supported", "span": "16 mm"}
ELASTIC = PAIR.replace(
    bodies={
        "disc": DISC,
        "pin": PINS,
        "output_pin": {"ends": "cantilever", "from": "-7 mm", "to": "6 mm", "diameter": "8 mm"},
        "ring": {"outer_radius": "50 mm", "width": "14 mm"},
    }
)
CRANKS = PAIR.replace(
    discs=2,
    supports={
        "kind": "cranks",
        "count": 3,
        "circle_radius": "20 mm",
        "turning_arm": {"rollers": 12, "roller_length": "6 mm", "clearance": "4 um"},
        "crank_shaft": {"stiffness": "300 N/um", "clearance": "2 um"},
        "main": {"stiffness": "800 N/um"},
        "pin_seat": {"stiffness_per_width": "30 GPa"},
    },
)
SOFT_CRANKS = CRANKS.replace(
    bodies={
        "disc_spacing": "11 mm",
        "crank": {"bearings": ["-17 mm", "17 mm"], "sections": [{"from": "-18 mm", "to": "18 mm", "diameter": "9 mm"}]},
        "carrier": {
            "columns": 3,
            "circle_radius": "22 mm",
            "length": "26 mm",
            "radial_width": "9 mm",
            "tangential_width": "7 mm",
            "share": 0.5,
        },
    }
)
ANGLES = np.array([0.3, 1.1, 2.5])


def solved(pair, torque=20.0, angles=ANGLES):
    return solve(DriveValue.as_stated(pair), [torque], angles, with_play=False)


def deviation(pair, torque=20.0, angles=ANGLES):
    return solved(pair, torque, angles).transmission_error[0]


# --- an independent solver ---


@pytest.mark.slow(60)
@pytest.mark.parametrize("name", ["rollers-one-disc", "rv-all-bodies", "rv-fan-windows"])
def test_an_analysis_agrees_with_an_independent_solver(name):
    """Within a tenth to a half of what the comparison allows."""
    expected = json.loads((CASES / f"{name}.json").read_text())
    pair = parse_pair((CASES / f"{name}.toml").read_text(), name)
    angles = expected["crank_angle"][::6]
    for result in expected["results"]:
        want = {key: values[::6] for key, values in result.items() if key != "torque"}
        data = cy.Drive(pair).analyze(result["torque"], crank_angle=angles)
        rigid = cy.Drive(pair.replace(bodies=None)).analyze(result["torque"], crank_angle=angles)
        moved = np.abs(np.array(want["transmission_error"]) - rigid.transmission_error.values[0])
        error = np.abs(data.transmission_error.values[0] - want["transmission_error"])
        assert (error < np.maximum(0.05 / cy.ARCSEC, 4e-3 * moved)).all()
        assert data.torsional_stiffness.values[0] == pytest.approx(want["torsional_stiffness"], rel=5e-3)
        for force, share in (
            ("pin_force", 5e-3),
            ("turning_arm_force", 2e-3),
            ("crank_bearing_force", 2e-3),
            ("output_roller_force", 2e-3),
        ):
            if force in data:
                wanted = np.array(want[force]).reshape(data[force].values[0].shape)
                assert np.abs(data[force].values[0] - wanted).max() < share * wanted.max(), force
        torque = data.crank_torque.values[0] - want["crank_torque"]
        assert np.abs(torque).max() < 1e-4 * abs(result["torque"]) / pair.gear_teeth
        total = 1.0 / data.torsional_stiffness.values[0]
        for number, part in enumerate(PARTS):
            shares = [each.get(part, 0.0) for each in want["compliance"]]
            assert (np.abs(data.compliance.values[0, :, number] - shares) < 5e-3 * total).all(), part


@pytest.mark.parametrize("angle", [0.3, *(pytest.param(a, marks=pytest.mark.slow(2)) for a in (1.1, 2.5))])
def test_half_shell_seats_agree_with_a_second_computation(angle):
    """Without elastic bodies: bisection of the whole law of pin, flank and seat, another iteration."""
    pair = PAIR.replace(supports=PAIR.supports.replace(pin_seat={"kind": "half_shell", "clearance": "4 um"}))
    found = solved(pair, angles=[angle])
    other = elastic_equilibrium.Drive(PAIR, BodyMatrices(), angle, half_shell=4e-6).solution(20.0)
    assert found.transmission_error[0, 0] == pytest.approx(other.x, abs=1e-4 / cy.ARCSEC)
    assert found.pin_force[0, 0] == pytest.approx(other.pin_force, rel=1e-5, abs=1e-3)


@pytest.mark.slow(2)
@pytest.mark.parametrize("pair", [ELASTIC, SOFT_CRANKS], ids=["output_rollers", "cranks"])
def test_a_drive_agrees_with_a_second_computation(pair):
    """All ports in plain NumPy; of rigid discs their 48 sectors are the bearings' continuum within 0.01″."""
    matrices, found = matrices_of(pair, pair.bodies), solved(pair)
    for number, angle in enumerate(ANGLES):
        other = elastic_equilibrium.Drive(pair, matrices, angle).solution(20.0)
        assert found.transmission_error[0, number] == pytest.approx(other.x, abs=0.01 / cy.ARCSEC)
        assert found.torsional_stiffness[0, number] == pytest.approx(other.stiffness, rel=2e-3)
        assert np.abs(found.pin_force[0, number] - other.pin_force).max() < 1e-3 * other.pin_force.max()
        assert found.crank_torque[0, number] == pytest.approx(other.crank_torque, abs=1e-4 * 20.0 / pair.gear_teeth)
        for part, name in enumerate(PARTS):
            share = other.compliance.get(name, 0.0)
            assert found.compliance[0, number, part] == pytest.approx(share, abs=2e-3 / other.stiffness), name


# --- limits ---


def test_bodies_without_compliance_are_rigid_bodies():
    """Beams of 1e25 Pa through the balance of ports, the contacts' own law: the drive on its bearings."""
    stiff = ELASTIC.bodies.replace(disc=None)
    stiff = stiff.replace(**{name: body.replace(youngs_modulus=1e25) for name, body in stiff.stated()})
    for pair in (
        PAIR.replace(bodies=stiff),
        CRANKS.replace(
            bodies=SOFT_CRANKS.bodies.replace(
                carrier=None, crank=None, pin=PINS | {"span": "26 mm", "youngs_modulus": 1e25}
            )
        ),
    ):
        elastic, rigid = solved(pair), solved(pair.replace(bodies=None))
        assert elastic.transmission_error == pytest.approx(rigid.transmission_error, abs=1e-6 / cy.ARCSEC)
        assert elastic.pin_force == pytest.approx(rigid.pin_force, abs=1e-3)
        assert elastic.crank_torque == pytest.approx(rigid.crank_torque, abs=1e-6)


@pytest.mark.parametrize("pair", [ELASTIC, SOFT_CRANKS], ids=["output_rollers", "cranks"])
def test_shares_are_the_compliance_which_is_the_slope(pair):
    low, found, high = solved(pair, 19.99), solved(pair), solved(pair, 20.01)
    slope = (high.transmission_error - low.transmission_error) / 0.02
    assert 1.0 / found.torsional_stiffness == pytest.approx(slope, rel=1e-3)
    assert found.compliance.sum(axis=-1) == pytest.approx(slope, rel=0.02)  # the rest is geometric stiffness
    for body, _ in pair.bodies.stated():
        assert (found.compliance[..., PARTS.index(body)] > 0.0).all(), body


@pytest.mark.parametrize("pair", [ELASTIC, SOFT_CRANKS], ids=["output_rollers", "cranks"])
def test_power_balances_at_every_crank_angle(pair):
    """∂τ/∂T = 1/z_c - ∂x/∂θ: reciprocity of crank and output, which fails by 1e-3 without dC/dθ."""
    torque, step = 1e-3, 1e-4
    by_torque = (solved(pair, 20.0 + torque).crank_torque - solved(pair, 20.0 - torque).crank_torque) / (2.0 * torque)
    by_angle = (deviation(pair, angles=ANGLES + step) - deviation(pair, angles=ANGLES - step)) / (2.0 * step)
    assert by_torque[0] == pytest.approx(1.0 / pair.gear_teeth - by_angle, rel=4e-4)


def test_the_mirrored_drive_turns_the_other_way():
    """Of one disc whose first output roller is on +x."""
    pair = ELASTIC.replace(supports=ELASTIC.supports.replace(first_angle=0.0))
    assert deviation(pair, -20.0, -ANGLES) == pytest.approx(-deviation(pair), abs=0.02 / cy.ARCSEC)


def test_load_sharing_moves_with_the_bodies():
    """The discs' forces are in balance with the torque of the output whatever bears them."""
    found = solved(ELASTIC)
    assert np.abs(found.pin_force - solved(PAIR).pin_force).max() > 0.02 * found.pin_force.max()
    assert (found.torsional_stiffness < solved(PAIR).torsional_stiffness).all()


# --- sensitivities ---


@pytest.mark.parametrize("pair", [ELASTIC, SOFT_CRANKS], ids=["output_rollers", "cranks"])
def test_sensitivities_are_differences(pair):
    drive = DriveValue.as_stated(pair)
    found, layout = sensitivity(drive, 20.0, ANGLES), displacement_layout(pair)
    step = 2e-8
    for pin in (1, 4, 8):
        for key in ("pin_radial", "pin_tangential"):
            column = found.by_displacement[:, layout[key].start + pin]
            moved = [step if number == pin else 0.0 for number in range(pair.pins)]
            ends = [deviation(pair.replace(errors={key: [way * each for each in moved]})) for way in (1.0, -1.0)]
            assert (ends[0] - ends[1]) / (2.0 * step) == pytest.approx(column, abs=2e-3 + 1e-3 * np.abs(column).max())
    low, high = (deviation(pair, angles=ANGLES + way * 1e-4) for way in (-1.0, 1.0))
    assert (high - low) / 2e-4 == pytest.approx(found.by_crank_angle, abs=2e-7)
    low, high = (deviation(pair, 20.0 + way * 2e-3) for way in (-1.0, 1.0))
    assert (high - low) / 4e-3 == pytest.approx(found.by_torque, rel=1e-3)
    for name in ("turning_arm", "crank_shaft", "main", "output_roller"):
        stated = getattr(pair.supports, name)
        if stated is None:
            continue
        for key, size in (("stiffness", 1e-4), ("clearance", 1e-8)):
            value = getattr(stated, key)
            if value is None or value == 0.0:
                continue
            ends = [
                deviation(
                    pair.replace(
                        supports=pair.supports.replace(
                            **{
                                name: stated.replace(
                                    **{key: value * (1.0 + way * size) if key == "stiffness" else value + way * size}
                                )
                            }
                        )
                    )
                )
                for way in (1.0, -1.0)
            ]
            column = found.by_bearing[:, LAWS.index(f"{name}_{key}")]
            assert (ends[0] - ends[1]) / (2.0 * size) == pytest.approx(column, rel=2e-3, abs=1e-9), f"{name} {key}"


@pytest.mark.parametrize("pair", [ELASTIC, SOFT_CRANKS], ids=["output_rollers", "cranks"])
def test_sensitivities_to_the_stiffness_of_bodies_are_differences(pair):
    """And the stiffer a body, the less the output gives way."""
    found, step = sensitivity(DriveValue.as_stated(pair), 20.0, ANGLES), 1e-3
    for name, _ in pair.bodies.stated():
        ends = [deviation(pair.replace(bodies=pair.bodies.with_factors({name: math.exp(d)}))) for d in (step, -step)]
        column = found.by_bearing[:, parameters_of(pair).index(f"{name}_stiffness")]
        assert (ends[0] - ends[1]) / (2.0 * step) == pytest.approx(column, rel=1e-3), name
        assert (column < 0.0).all()


@pytest.mark.parametrize(
    ("pair", "name"),
    [
        *((ELASTIC, name) for name in ("pin", "output_pin", "ring")),
        *((SOFT_CRANKS, name) for name in ("crank", "carrier")),
        pytest.param(ELASTIC, "disc", marks=pytest.mark.slow(4)),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_a_factor_is_another_modulus(pair, name):
    """A body's influence goes with one over its modulus, also that of finite elements."""
    body = getattr(pair.bodies, name)
    stiffer = body.replace(youngs_modulus=1.7 * 206e9 if body.youngs_modulus is None else 1.7 * body.youngs_modulus)
    found, expected, before = (
        cy.Drive(pair).influence(bodies=bodies)[name]
        for bodies in (pair.bodies.with_factors({name: 1.7}), pair.bodies.replace(**{name: stiffer}), pair.bodies)
    )
    if isinstance(found, dict):
        found, expected, before = (each["compliance"] for each in (found, expected, before))
    assert found == pytest.approx(expected, rel=1e-9)
    assert found == pytest.approx(before / 1.7, rel=1e-12)


# --- files, and what refuses bodies ---


def test_a_pair_with_bodies_is_its_text(tmp_path):
    for name in ("rollers-one-disc", "rv-all-bodies", "rv-fan-windows"):
        pair = parse_pair((CASES / f"{name}.toml").read_text(), name)
        assert parse_pair(pair.text, name) == pair
        assert "bodies" not in pair.replace(bodies=None).text
    assert "half_shell" not in PAIR.text


def test_what_does_not_use_bodies_refuses_them():
    with pytest.raises(cy.InputError, match="elastic bodies are loaded alike over the width"):
        cy.Drive(SOFT_CRANKS).analyze(20.0, angles=2, slices=3)
    with pytest.raises(cy.InputError, match="needs \\[supports\\]"):
        SMALL.replace(supports=None, bodies={"disc": DISC})


def test_a_profile_has_the_holes_of_its_elastic_disc(tmp_path):
    """Bores, hole in the middle and fans, whose corners are tangent: the area of a fan by its arcs is that of a fan."""
    pair = parse_pair((CASES / "rv-fan-windows.toml").read_text(), "rv-fan-windows")
    sharp = pair.bodies.disc.windows[0].replace(corner_radius=None)
    pair = pair.replace(bodies=pair.bodies.replace(disc=pair.bodies.disc.replace(windows=(sharp,))))
    made = cy.Drive(pair).profile()
    assert sorted(made.hole_radius.tolist()) == pytest.approx([12e-3, 12.5e-3, 12.5e-3, 12.5e-3])
    assert len(made.windows) == sharp.count
    for start, bulge in made.windows:
        end, angle = np.roll(start, -1), 4.0 * np.arctan(bulge)
        round_ = np.abs(angle) > 1e-9
        radius = np.abs(end - start)[round_] / (2.0 * np.sin(0.5 * np.abs(angle[round_])))
        beside = 0.5 * radius**2 * (angle - np.sin(angle))[round_]
        area = 0.5 * (np.conj(start) * end).imag.sum() + beside.sum()
        fan = sharp.half_angle * (sharp.outer_radius**2 - sharp.inner_radius**2)
        assert area == pytest.approx(fan, rel=1e-9)
