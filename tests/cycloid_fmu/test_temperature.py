"""Drives at temperature: expansion of all bodies together and of each separately, clearances, and checks of files."""

import json

import numpy as np
import pytest
from common import ARCSEC, EXAMPLES
from scipy.spatial import cKDTree

import cycloid_fmu as cy
from cycloid_fmu import contact, edge
from cycloid_fmu.analysis import solve
from cycloid_fmu.contact.transmission import rigid_problem
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.geometry.pair import parse_pair, read_pair
from cycloid_fmu.geometry.profile import flank_points
from cycloid_fmu.geometry.temperature import STEEL, parse_temperatures
from cycloid_fmu.surfaces.surface import surface_of_pair

ALUMINIUM = 23.1e-6
WARM = dict.fromkeys(("ring", "discs", "carrier", "crank"), "50 degC")
SIZES = {
    "gear_teeth": 39,
    "pin_circle_radius": 64e-3,
    "pin_radius": 3e-3,
    "eccentricity": 1.3e-3,
    "face_width": 0.01,
    "rated_torque": 181.0,
    "modification": {"isometric": -15e-6, "offset": -40e-6},
}
CRANKS = {
    "kind": "cranks",
    "count": 3,
    "circle_radius": 0.036,
    "first_angle": 0.3,
    "turning_arm": {"rollers": 15, "roller_length": 9e-3, "clearance": 8e-6, "raceway_diameter": 22e-3},
    "crank_shaft": {"stiffness": 3e8, "clearance": 2e-6, "raceway_diameter": 30e-3},
    "main": {"stiffness": 1.2e9},
    "pin_seat": {"stiffness_per_width": 30e9, "clearance": 3e-6},
}
ROLLERS = {
    "kind": "output_rollers",
    "count": 6,
    "circle_radius": 0.032,
    "turning_arm": {"stiffness": 4e8},
    "output_roller": {"stiffness": 2e8, "clearance": 6e-6, "radius": 5e-3},
}
ANGLES = np.linspace(0.0, 2.0 * np.pi, 37, endpoint=False)


def solved(pair, torque, surface=None):
    return solve(DriveValue(pair, surface or surface_of_pair(pair)), torque, ANGLES)


def form(pair):
    """Flanks that are off by some µm, and pins by some others."""
    gear = 2e-6 * np.cos(np.linspace(0.0, 3.0 * np.pi, 30))
    pins = 1e-6 * np.cos(np.linspace(0.0, 5.0, 20))
    return surface_of_pair(pair).replace(
        gear_deviation=np.broadcast_to(gear[:, None], (1, 39, 30, 1)),
        pin_deviation=np.broadcast_to(pins[:, None], (40, 20, 1)),
    )


@pytest.mark.parametrize("output", ["gear", "ring"])
def test_a_drive_of_one_material_that_is_warm_all_over_keeps_its_play(output):
    """Angles do not depend on the scale; rotations under torque change as the scale does, 0.03 %."""
    pair = cy.Pair(**SIZES, output=output)
    cold, warm = solved(pair, [181.0]), solved(pair.replace(temperature=WARM), [181.0])
    assert warm.backlash == pytest.approx(cold.backlash, abs=1e-8 * ARCSEC)
    assert np.abs(warm.transmission_error - cold.transmission_error).max() > 0.0
    elastic = cold.transmission_error - cold.play_high
    assert warm.transmission_error - warm.play_high == pytest.approx(elastic, rel=5.0 * STEEL * 30.0)


def test_form_stays_on_the_flanks_that_grow():
    pair = cy.Pair(**SIZES)
    surface, warm = form(pair), pair.replace(temperature=WARM)
    # The form itself does not grow: 3e-4 of 3 µm.
    assert solved(warm, [1.0], surface).backlash == pytest.approx(
        solved(pair, [1.0], surface).backlash, abs=0.01 * ARCSEC
    )


@pytest.mark.parametrize("supports", [CRANKS, ROLLERS], ids=lambda s: s["kind"])
def test_a_drive_on_bearings_that_is_warm_all_over_changes_by_its_scale(supports):
    pair = cy.Pair(**SIZES, discs=2, supports=supports)
    cold, warm = solved(pair, [181.0]), solved(pair.replace(temperature=WARM), [181.0])
    assert warm.backlash == pytest.approx(cold.backlash, rel=1e-3)
    assert warm.transmission_error == pytest.approx(cold.transmission_error, rel=2e-3)
    assert warm.turning_arm_force == pytest.approx(cold.turning_arm_force, rel=2e-3, abs=2.0)


def test_an_aluminium_ring_opens_the_play_by_the_closed_form():
    """The pin with the smallest increase of its gap per arm is at cos φ = K: 2 δR_p √(1 - K²)/(e z_c)."""
    pair = cy.Pair(**{**SIZES, "modification": {"offset": -40e-6}})
    ring = pair.replace(temperature=WARM, expansion={"ring": ALUMINIUM})
    # The pins are steel and as warm as the ring, the discs too.
    growth = 64e-3 * (ALUMINIUM - STEEL) * 30.0
    k = 1.3 * 40.0 / 64.0
    opened = 2.0 * growth * np.sqrt(1.0 - k * k) / (1.3e-3 * 39.0)
    change = solved(ring, [1.0]).backlash - solved(pair, [1.0]).backlash
    assert opened == pytest.approx(105.6 * ARCSEC, abs=0.1 * ARCSEC)
    assert change == pytest.approx(opened, rel=0.01)


@pytest.mark.parametrize("supports", [None, CRANKS, ROLLERS], ids=["rigid", "cranks", "output_rollers"])
def test_a_warm_ring_is_a_larger_pin_circle_with_its_pins(supports):
    """With the discs at 20 °C the ring's expansion is an error that a file may state, with the sensitivity's size."""
    if supports is not None:
        supports = {**supports, "pin_seat": {}}
    pair = cy.Pair(**SIZES, discs=2, supports=supports)
    # Nothing else of the drive is in the ring.
    warm = pair.replace(temperature={"ring": "50 degC", "pins": "30 degC"}, expansion={"ring": ALUMINIUM})
    errors = {"pin_circle_radius": 64e-3 * ALUMINIUM * 30.0, "pin_radius": 3e-3 * STEEL * 10.0}
    found, wanted = solved(warm, [100.0]), solved(pair.replace(errors=errors), [100.0])
    assert found.transmission_error == pytest.approx(wanted.transmission_error, abs=1e-6 * ARCSEC)
    assert found.backlash == pytest.approx(wanted.backlash, abs=1e-6 * ARCSEC)
    if supports is not None:
        by = cy.Drive(pair).sensitivity(100.0, list(errors), crank_angle=ANGLES).values.mean(axis=1)
        change = (found.transmission_error - solved(pair, [100.0]).transmission_error).mean()
        assert change == pytest.approx(by @ list(errors.values()), rel=0.05)


def test_a_warm_disc_is_the_drawn_flank_enlarged():
    """Gaps to the flank's own points, each as much farther from the gear's centre, the crank and the ring cold."""
    pair = cy.Pair(**SIZES)
    warm = pair.replace(temperature={"discs": "80 degC"})
    drive = rigid_problem(DriveValue.as_stated(warm))
    rows = contact.contact_rows(drive)
    theta = 0.3
    contact.place_contacts(drive, theta, 0.0, rows, True, np.inf, np.inf)
    flank = np.array([1.0, 1.0j]) @ np.stack(flank_points(pair, np.linspace(0.0, 2.0 * np.pi, 400_001)))
    flank = flank * (1.0 + STEEL * 60.0) * np.exp(-1j * theta / 39.0) + 1.3e-3 * np.exp(1j * theta)
    axis = 64e-3 * np.exp(2j * np.pi * np.arange(40) / 40.0)
    near, _ = cKDTree(np.stack([flank.real, flank.imag], axis=1)).query(np.stack([axis.real, axis.imag], axis=1))
    assert np.minimum(rows["gap"][::2], rows["gap"][1::2]) == pytest.approx(near - 3e-3, abs=2e-9)


def test_a_warm_crank_throws_the_disc_farther():
    pair = cy.Pair(**SIZES)
    warm = pair.replace(temperature={"crank": "60 degC"})
    thrown = pair.replace(errors={"eccentricity": 1.3e-3 * STEEL * 40.0})
    assert solved(warm, [100.0]).transmission_error == pytest.approx(
        solved(thrown, [100.0]).transmission_error, abs=1e-7 * ARCSEC
    )


def test_a_warm_carrier_squeezes_the_cranks():
    """Cranks farther out than the holes: the same radial force at each, a δ/(1/k_a + n_d/k_s)."""
    stiff, soft = 4e8, 3e8
    supports = {
        "kind": "cranks",
        "count": 3,
        "circle_radius": 0.036,
        "turning_arm": {"stiffness": stiff},
        "crank_shaft": {"stiffness": soft},
    }
    pair = cy.Pair(**SIZES, discs=2, supports=supports, temperature={"carrier": "40 degC"})
    found = solved(pair, [0.1])
    force = 0.036 * STEEL * 20.0 / (1.0 / stiff + 2.0 / soft)
    assert force == pytest.approx(903.3, abs=0.1)
    assert found.turning_arm_force == pytest.approx(force, rel=0.002)
    assert found.crank_bearing_force == pytest.approx(2.0 * force, rel=0.002)


def test_clearances_are_what_is_left_between_the_grown_bodies():
    """Raceways, rollers, seats and holes by their own sizes, each grown with its body."""
    hot = {"ring": "45 degC", "pins": "40 degC", "discs": "60 degC", "carrier": "50 degC", "crank": "55 degC"}
    strain = {name: STEEL * (float(text.split()[0]) - 20.0) for name, text in hot.items()}
    grown = {name: 1.0 + share for name, share in strain.items()}
    warm = cy.Pair(**SIZES, supports=CRANKS, temperature=hot).at_temperature.supports
    roller = 2.5e-3
    inner = 22e-3 - 2.0 * roller - 8e-6
    left = 22e-3 * grown["discs"] - (inner + 2.0 * roller) * grown["crank"]
    assert warm.turning_arm.clearance == pytest.approx(left, abs=1e-12)
    assert left == pytest.approx(8e-6 + 22e-3 * STEEL * 5.0, abs=1e-8)
    left = 30e-3 * grown["carrier"] - (30e-3 - 2e-6) * grown["crank"]
    assert warm.crank_shaft.clearance == pytest.approx(left, abs=1e-12)
    assert warm.pin_seat.clearance == pytest.approx(6.003e-3 * grown["ring"] - 6e-3 * grown["pins"], abs=1e-12)
    output = cy.Pair(**SIZES, supports=ROLLERS, temperature=hot).at_temperature.supports.output_roller
    hole, eccentricity = 5e-3 + 1.3e-3 + 3e-6, 1.3e-3 * grown["discs"]
    left = 2.0 * (hole * grown["discs"] - 5e-3 * grown["carrier"] - eccentricity)
    assert output.clearance == pytest.approx(left, abs=1e-12)


def test_a_clearance_without_its_raceway_stays_and_results_say_so():
    arm = {k: v for k, v in CRANKS["turning_arm"].items() if k != "raceway_diameter"}
    pair = cy.Pair(**SIZES, supports={**CRANKS, "turning_arm": arm}, temperature={"discs": "30 degC"})
    assert pair.at_temperature.supports.turning_arm.clearance == 8e-6
    notes = cy.Drive(pair).analyze(100.0, angles=3).attrs["notes"]
    assert notes.endswith("not stated are: turning_arm.raceway_diameter.")
    alike = pair.replace(temperature={"discs": "30 degC", "crank": "30 degC", "carrier": "30 degC", "ring": "30 degC"})
    assert cy.Drive(alike).analyze(100.0, angles=3).attrs["notes"] == ""


@pytest.mark.parametrize("supports", [None, CRANKS], ids=["rigid", "cranks"])
def test_at_20_degrees_all_is_to_the_last_bit_as_drawn(supports):
    pair = cy.Pair(**SIZES, supports=supports, errors={"pin_radius": -1e-6, "pin_tangential": {2: (2e-6, 0.3)}})
    assert pair.at_temperature is pair
    assert "temperature" not in pair.text
    assert "expansion" not in pair.text
    warm = pair.replace(temperature={}, expansion={"ring": ALUMINIUM})
    found, drawn = solved(warm, [100.0]), solved(pair, [100.0])
    assert (found.transmission_error == drawn.transmission_error).all()
    assert (found.backlash == drawn.backlash).all()


def test_a_warm_drive_is_another_drive_of_the_same_parts():
    """Its text comes back; a surface that was measured at 20 °C belongs to it; a study draws warm drives."""
    pair = cy.Pair(**SIZES)
    warm = pair.replace(temperature={"ring": "50 degC", "discs": 313.15}, expansion={"ring": "23.1 um/(m*K)"})
    assert parse_pair(warm.text, "again") == warm
    assert warm.temperature.discs == 313.15
    assert warm.expansion.ring == ALUMINIUM
    cold, hot = cy.Drive(pair, form(pair)), cy.Drive(warm, form(pair))
    assert cold.surface.hash == hot.surface.hash
    assert len({cold.hash, hot.hash, cy.Drive(warm).hash, cy.Drive(pair).hash}) == 4
    assert cold.replace(temperature=warm.temperature, expansion=warm.expansion) == hot
    assert cy.Drive(pair, surface_of_pair(warm)) == cy.Drive(pair)
    assert hot.analyze(1.0, angles=3).attrs["temperature"] == "ring 50 °C, discs 40 °C, carrier 20 °C, crank 20 °C"
    study = cy.Drive(warm).study(
        cy.Tolerances(pin_radius={"tolerance": "0.01 um"}), [100.0], samples=2, angles=11, workers=1
    )
    play = cy.Drive(warm).analyze(100.0, angles=11).backlash.values.mean()
    assert study.result.figure("mean_backlash") == pytest.approx(play, rel=0.01)


@pytest.mark.parametrize(
    ("tables", "sentence"),
    [
        ("[temperature]\nring = 50", "one number with a decimal point, a space and a unit"),
        ("[temperature]\nring = '50'", 'one number with a decimal point, a space and a unit, such as "20 degC"'),
        ("[temperature]\nring = '50 mm'", "measures something else"),
        ("[temperature]\nring = '50 degF'", "has an offset"),
        ("[temperature]\nring = '-300 degC'", "a temperature must be between -60 degC and 200 degC"),
        ("[temperature]\ncrank = '900 degC'", "a temperature must be between -60 degC and 200 degC"),
        ("[temperature]\ndisc = '50 degC'", "did you mean discs"),
        ("[expansion]\nring = '0 1/K'", "an expansion coefficient must be above 0"),
        ("[expansion]\nring = '-23e-6 1/K'", "an expansion coefficient must be above 0"),
        ("[expansion]\nring = '23.1 1/K'", "at most 0.0003 1/K"),
        (
            "[supports.turning_arm]\nraceway_diameter='22 mm'\nstiffness='400 N/um'\n[temperature]\ncrank='60 degC'",
            "the clearance of turning_arm falls to -10.1 um; the model has no preload",
        ),
        ("[temperature]\ncarrier='60 degC'", "turning_arm is rigid, but carrier and discs expand differently"),
    ],
)
def test_temperatures_that_can_not_be_are_refused_in_a_sentence(tables, sentence):
    text = cy.Pair(**SIZES, supports={"kind": "cranks", "count": 3, "circle_radius": 0.036}).text
    with pytest.raises(edge.InputError) as problem:
        parse_pair(text + tables, "p.toml")
    assert sentence in str(problem.value)
    assert str(problem.value).startswith("p.toml: ")
    assert "\n" not in str(problem.value)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("60", 'temperature = "60": write one number with a decimal point, a space and a unit, such as "20 degC".'),
        ("ring = -300 degC", 'temperature = "ring = -300 degC": a temperature must be between -60 degC and 200 degC.'),
        (
            "rotor = 30 degC",
            'temperature = "rotor = 30 degC": give each of ring, pins, discs, carrier, crank at most',
        ),
        ("disc = 30 degC", "did you mean discs"),
        ("ring = 30 degC, ring = 40 degC", "crank at most once"),
        ("30 degC, discs = 40 degC", "or one temperature for all"),
    ],
)
def test_a_text_of_temperatures_is_refused_in_a_sentence(text, sentence):
    with pytest.raises(edge.ArgumentError) as problem:
        parse_temperatures(text)
    assert sentence in str(problem.value)


def test_analyze_takes_temperatures_and_names_them(command, tmp_path):
    """The command is the Python call; bodies that the option does not name are those of the file."""
    (tmp_path / "p.toml").write_text(
        (EXAMPLES / "drive-39-40.toml").read_text()
        + '[temperature]\ndiscs = "40 degC"\n[expansion]\nring = "23.1e-6 1/K"\n'
    )
    words = ["p.toml", "--torque", "100 N*m", "--angles", "7", "--temperature"]
    done = command("cycloid-fmu", "analyze", *words, "ring = 50 degC", "--json")
    drive = cy.Drive(read_pair(tmp_path / "p.toml")).replace(temperature={"ring": "50 degC", "discs": "40 degC"})
    wanted = drive.analyze(100.0, angles=7).backlash.values.tolist()
    assert json.loads(done.stdout)["backlash"] == wanted
    done = command("cycloid-fmu", "analyze", *words, "50 degC", "--plot", "p.png")
    assert "all at 50 °C" in done.stdout
    done = command("cycloid-fmu", "analyze", *words, "ring = 900 degC")
    assert done.returncode == 2
    assert '--temperature = "ring = 900 degC": a temperature must be between' in done.stderr
