"""Drives from a wish: what is sized fits, bears its load and turns, and what can't be says what can."""

import math
import re
import runpy
from pathlib import Path

import numpy as np
import pytest
from common import make_pair
from matplotlib.path import Path as Polygon

from cycloid_fmu import edge
from cycloid_fmu.analysis import solve
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.geometry.materials import CONTACT_YIELD, MATERIALS
from cycloid_fmu.geometry.pair import Material, parse_pair
from cycloid_fmu.geometry.processes import PROCESSES, standard_tolerance
from cycloid_fmu.geometry.profile import flank_points
from cycloid_fmu.studies import tolerance
from cycloid_fmu.studies.sized_figures import disc_mass, figures_of
from cycloid_fmu.studies.sizing import Wish, largest_pressure, size
from cycloid_fmu.surfaces.sampling import parse_tolerances
from cycloid_fmu.surfaces.surface import surface_of_pair

ROOT = Path(__file__).parents[2]
CNC = {"ratio": 15, "outer_diameter": "70 mm", "torque": "20 N*m", "material": "7075-T6", "process": "CNC"}
PRINTED = {"ratio": 11, "outer_diameter": "90 mm", "torque": "8 N*m", "material": "printed PLA", "process": "FDM"}


@pytest.fixture(scope="module", params=[CNC, pytest.param(PRINTED, marks=pytest.mark.slow(4))], ids=["CNC", "printed"])
def sized(request):
    return size(Wish(**request.param))


@pytest.mark.parametrize(
    ("grade", "size_mm", "tabulated"),
    [(5, 4, 5), (6, 40, 16), (7, 65, 30), (8, 100, 54), (10, 8, 58), (11, 8, 90), (11, 65, 190), (13, 150, 630)],
)
def test_standard_tolerances_are_those_of_the_table(grade, size_mm, tabulated):
    # ISO 286-1, table 1: for ranges of sizes, at whose geometric mean the formula holds; at another size within 10 %.
    assert standard_tolerance(grade, size_mm * 1e-3) * 1e6 == pytest.approx(tabulated, rel=0.1)


@pytest.mark.parametrize("name", MATERIALS)
def test_ranges_of_materials_are_ranges(name):
    value = MATERIALS[name]
    for low, high in (value.youngs_modulus, value.expansion, value.density):
        assert 0.0 < low <= high
    assert value.youngs_modulus[0] <= value.modulus <= value.youngs_modulus[1]
    # Sound in a rod: between that of lead and that of beryllium.
    assert 1100.0 < math.sqrt(value.modulus / value.density[0]) < 13000.0
    assert value.largest_pressure < 0.05 * value.modulus


def test_first_yield_of_a_line_contact():
    # The largest shear stress below a line contact is 0.300 p_0 at 0.78 a (Johnson 4.45): Tresca's limit Y/2 is there.
    depth = np.linspace(0.1, 2.0, 2000)
    root = np.sqrt(1.0 + depth**2)
    across, down = -((1.0 + 2.0 * depth**2) / root - 2.0 * depth), -1.0 / root
    assert np.max(0.5 * np.abs(across - down)) * CONTACT_YIELD == pytest.approx(0.5, rel=0.01)


def test_a_named_material_fills_in_what_is_not_stated():
    named = Material(name="7075-T6")
    assert (named.youngs_modulus, named.poissons_ratio) == (MATERIALS["7075-T6"].modulus, 0.33)
    assert Material(name="7075-T6", youngs_modulus="70 GPa").youngs_modulus == 70e9
    numbers = '[material.gear]\nyoungs_modulus = "206 GPa"\npoissons_ratio = 0.3\n'
    in_file = make_pair().text.replace(numbers, '[material.gear]\nname = "7075-T6"\n')
    assert parse_pair(in_file, "named").material.gear == named
    with pytest.raises(edge.InputError, match='name = "7075": did you mean'):
        Material(name="7075")


def test_the_weaker_material_gives_the_limit_and_an_unknown_one_gives_none():
    soft = make_pair().replace(material={"gear": {"name": "POM"}, "pin": {"name": "bearing steel"}})
    assert soft.largest_pressure.pressure == MATERIALS["POM"].largest_pressure
    assert soft.replace(pressure_limit="90 MPa").largest_pressure.pressure == 90e6
    unknown = make_pair().replace(material={"gear": {"youngs_modulus": "70 GPa"}})
    assert unknown.largest_pressure is None
    assert make_pair().largest_pressure == (4e9, "of hardened bearing steel (ISO 76)")


def test_the_drive_bears_its_torque_and_no_more_width_than_that_needs(sized):
    pair = sized.pair
    turn = np.linspace(0.0, 2.0 * np.pi, 77, endpoint=False)

    def pressure(one):
        found = solve(DriveValue(one, surface_of_pair(one)), np.array([pair.rated_torque]), turn, with_play=False)
        return found.max_contact_pressure.max()

    limit = pair.largest_pressure.pressure
    assert pressure(pair) <= 1.003 * limit
    # A millimetre less is too little: half a millimetre of rounding, and as much again where the bearings gave way.
    narrower = pressure(pair.replace(face_width=pair.face_width - 1e-3))
    assert narrower > limit or "eccentric bearing" in sized.reasons["pair.face_width"]


def test_most_drives_of_the_process_turn_freely(sized):
    pair = sized.pair.replace(supports=None, losses=None)
    tolerances = parse_tolerances(sized.tolerances, "sized")
    study = tolerance.Study(pair, tolerances, samples=128, seed=77, torque=(pair.rated_torque,), angles=90)
    surfaces = [tolerance.surface_of(study, point) for point in tolerance.points(study)]
    column = next(k for k, (name, _) in enumerate(study.columns) if name == "interference")
    free = (tolerance.exact_figures(study, surfaces)[:, column] <= 0.0).mean()
    assert free > 0.88  # 95 % asked; three standard errors of 128 drives are 6 %


def test_parts_are_apart_by_the_wall_of_the_process(sized):
    pair, supports, wall = sized.pair, sized.pair.supports, PROCESSES[sized.wish.process].wall
    flank = np.stack(flank_points(pair, np.linspace(0.0, 2.0 * np.pi, 20001)), axis=1)
    at = supports.circle_radius * np.exp(2j * np.pi * np.arange(supports.count) / supports.count)
    hole = supports.output_roller.radius + pair.eccentricity
    assert np.abs(at[1] - at[0]) - 2.0 * hole >= wall - 1e-9
    assert supports.circle_radius - hole - sized.bodies.disc.bore_radius >= wall - 1e-4
    assert np.linalg.norm(flank, axis=1).min() - supports.circle_radius - hole >= wall - 1e-4
    outside = 2.0 * (pair.pin_circle_radius + pair.pin_radius + wall)
    assert sized.wish.outer_diameter - 1e-3 < outside <= sized.wish.outer_diameter + 1e-9


def test_mass_of_a_disc_is_that_of_points_inside_it(sized):
    pair, supports = sized.pair, sized.pair.supports
    flank = np.stack(flank_points(pair, np.linspace(0.0, 2.0 * np.pi, 2001)), axis=1)
    reach = np.abs(flank).max()
    points = np.random.default_rng(5).uniform(-reach, reach, (100_000, 2))
    inside = Polygon(flank).contains_points(points)
    inside &= np.linalg.norm(points, axis=1) > sized.bodies.disc.bore_radius
    for angle in 2.0 * np.pi * np.arange(supports.count) / supports.count:
        centre = supports.circle_radius * np.array([np.cos(angle), np.sin(angle)])
        inside &= np.linalg.norm(points - centre, axis=1) > sized.bodies.disc.roller_hole_radius
    weight = np.mean(MATERIALS[sized.wish.material].density) * pair.face_width * 4.0 * reach**2 / len(points)
    mass, inertia = disc_mass(pair, sized.bodies)
    assert mass == pytest.approx(weight * inside.sum(), rel=0.01)
    assert inertia == pytest.approx(weight * (points[inside] ** 2).sum(), rel=0.01)


def test_ranges_are_those_of_a_tolerance_study(sized):
    """Errors leave the load to fewer pins: nearly every drive presses harder than the one as drawn."""
    pair, tolerances = sized.pair, parse_tolerances(sized.tolerances, "sized")
    figures = {row.name: row for row in figures_of(DriveValue.as_stated(pair), tolerances, sized.bodies)[0]}
    study = tolerance.Study(pair, tolerances, 64, 1, (pair.rated_torque,), angles=91)
    found = tolerance.run(study)
    for name in ("backlash", "angular transmission error"):
        assert figures[name].values[1:] == pytest.approx(
            np.quantile(found.figure(name.replace(" ", "_")), (0.05, 0.95)), rel=1e-6
        )
    pressure, (drawn, low, high) = found.figure("max_contact_pressure"), figures["contact pressure"].values
    assert (low, high) == pytest.approx(np.quantile(pressure, (0.05, 0.95)), rel=1e-6)
    assert drawn < low
    over = np.sum(pressure > pair.largest_pressure.pressure)
    assert figures["contact pressure"].basis.endswith(f"{over} of 64 drives exceed the permitted")


def test_every_figure_with_a_range_has_it_around_the_drawn_value(sized):
    tolerances = parse_tolerances(sized.tolerances, "sized")
    figures, stresses = figures_of(DriveValue.as_stated(sized.pair), tolerances, sized.bodies)
    rows = {row.name: row.values for row in figures}
    for name in ("mass of discs and pins", "inertia of the discs at the input", "efficiency"):
        drawn, low, high = rows[name]
        assert 0.0 < low <= drawn <= high
    assert rows["efficiency"][1] < rows["efficiency"][2] <= 1.0
    assert rows["backlash"][1] < rows["backlash"][2]
    strong = {(one.part, one.kind): one for one in stresses}
    assert strong["output pin", "fatigue"].safety > 1.5  # sized for a beam on two supports; it is clamped
    if sized.wish.material == "printed PLA":
        assert "fatigue strength" in strong["disc", "fatigue"].reason


def test_the_commented_bodies_are_those_of_the_wish_with_bodies(sized):
    lines = sized.text.splitlines()
    first = next(k for k, line in enumerate(lines) if line.startswith("# [bodies]"))
    block = "\n".join(line.removeprefix("# ") for line in lines[first:])
    elastic = parse_pair(sized.text.split("# Elastic bodies")[0] + block + "\n", "with bodies")
    assert elastic.bodies == sized.bodies
    disc, supports = sized.bodies.disc, sized.pair.supports
    assert disc.roller_hole_radius == pytest.approx(
        supports.output_roller.radius + sized.pair.eccentricity + 0.5 * supports.output_roller.clearance
    )


@pytest.mark.slow(6)
def test_a_ring_without_pins_is_of_the_discs_material_and_has_no_friction_from_the_table():
    drive = size(Wish(**{**PRINTED, "ring": "conjugate", "torque": "3 N*m"}))
    assert drive.pair.material.pin == drive.pair.material.gear
    assert drive.pair.losses is None
    assert any("no friction of printed PLA on printed PLA" in note for note in drive.notes)
    softer = size(Wish(**{**PRINTED, "torque": "3 N*m"}))
    assert drive.pair.material.pin.compliance > 20.0 * softer.pair.material.pin.compliance


@pytest.mark.slow(2)
def test_discs_keep_within_the_stated_length():
    drive = size(Wish(**{**CNC, "torque": "5 N*m", "length": "16 mm"}))
    pair = drive.pair
    assert pair.discs * pair.face_width + (pair.discs + 1) * 0.5e-3 <= 16e-3 + 1e-9


@pytest.mark.slow(20)
def test_a_length_without_room_names_one_that_has_room():
    with pytest.raises(
        edge.ArgumentError, match=r"length = 0\.003: 2 discs of at least 2 mm with gaps of 0.5 mm take 5.5 mm"
    ) as refused:
        size(Wish(**{**CNC, "torque": "5 N*m", "length": "3 mm"}))
    (length,) = re.findall(r"([0-9.]+) mm of length would be possible", str(refused.value))
    # The narrowest eccentric bearings are 5 mm wide.
    assert float(length) >= 2 * 5.0 + 3 * 0.5


def test_the_page_has_the_tables_of_the_code():
    page = ROOT / "docs" / "new_drive.md"
    assert runpy.run_path(str(ROOT / "docs" / "materials.py"))["page"]() == page.read_text(encoding="utf-8")


def test_the_text_with_reasons_is_the_pair(sized):
    assert parse_pair(sized.text, "sized") == sized.pair
    assert re.search(r"^pin_radius = .*# largest dowel", sized.text, re.MULTILINE)


def long_numbers(drive):
    """Numbers of a drive's files with more digits than a drawing has: a pin circle to 1 µm, a modification to 1 nm."""
    numbers = re.findall(r"\d+(?:\.\d+)?(?:e[+-]?\d+)?", drive.text + drive.tolerances)
    return [number for number in numbers if len(number.partition("e")[0].replace(".", "").strip("0")) > 5]


def test_files_have_numbers_of_a_drawing(sized):
    assert long_numbers(sized) == []


@pytest.mark.slow(4)
def test_files_have_numbers_of_a_drawing_with_any_bearing():
    """One of 72 mm outside diameter and 9 mm width: 1e-3 times either is not the float next to the size."""
    wish = Wish(ratio=19, outer_diameter="120 mm", torque="40 N*m", material="quenched steel", process="grinding")
    drive = size(wish)
    assert drive.pair.supports.turning_arm.raceway_diameter == 0.072
    assert long_numbers(drive) == []


@pytest.mark.slow(2)
def test_the_ring_as_output_has_one_tooth_less_than_the_ratio():
    drive = size(Wish(**{**CNC, "output": "ring", "discs": 3}))
    assert (drive.pair.gear_teeth, drive.pair.ratio, drive.pair.supports) == (14, 15.0, None)
    assert any("ring" in note for note in drive.notes)
    assert "discs = 3  # evenly around the crank, so balanced" in drive.text


def offers(refused):
    """{"outer diameter": mm, …} of the sentence that refuses a wish."""
    said = re.findall(r"([0-9.]+) (?:mm|N\*m|h) of ([a-z ]+?)(?= or | would)", str(refused.value))
    return {name: float(value) for value, name in said}


@pytest.mark.slow(20)
def test_an_impossible_wish_names_what_is_possible():
    wish = Wish(**{**CNC, "outer_diameter": "60 mm", "torque": "80 N*m"})
    with pytest.raises(edge.ArgumentError, match=r"torque = 80\.0: at the largest face width, 9 mm a disc,") as refused:
        size(wish)
    possible = offers(refused)
    assert 60.0 < possible["outer diameter"] < 300.0
    assert 0.0 < possible["torque"] < 80.0
    for changed in (
        wish.replace(torque=possible["torque"]),
        wish.replace(outer_diameter=possible["outer diameter"] * 1e-3),
    ):
        pair = size(changed).pair
        assert largest_pressure(pair) <= pair.largest_pressure.pressure


@pytest.mark.slow(20)
@pytest.mark.parametrize("torque", ["1000 N*m", "1e9 N*m"])
def test_a_torque_that_no_contacts_balance_is_named(torque):
    # In polymer of 1.6 GPa pins leave the teeth.
    changes = {"outer_diameter": "40 mm", "torque": torque, "material": "POM", "process": "SLS"}
    with pytest.raises(edge.ArgumentError, match=r"^torque = .*: no contacts that fit can balance it; ") as refused:
        size(Wish(**{**CNC, **changes}))
    assert bool(offers(refused)) == (torque == "1000 N*m")


@pytest.mark.slow(20)
def test_the_eccentric_bearing_lives_as_long_as_wished():
    life, rpm = 3000.0, 1500.0
    wish = Wish(**{**CNC, "outer_diameter": "80 mm", "life": f"{life} h", "crank_speed": f"{rpm} rpm"})
    pair = size(wish).pair
    swept = solve(DriveValue(pair, surface_of_pair(pair)), [20.0], np.linspace(0.0, 2.0 * np.pi, 77, endpoint=False))
    # ISO 281 for balls; the inner ring turns 1 + 1/z_c times relative to the disc in a crank turn.
    load = np.cbrt((swept.turning_arm_force[0] ** 3).mean(axis=0)).max()
    turns = 1e6 * (pair.supports.turning_arm.dynamic_capacity / load) ** 3
    hours = turns / (60.0 * rpm * (1.0 + 1.0 / pair.gear_teeth))
    assert hours >= life
    wish = wish.replace(life=2.0 * hours * 3600.0)
    with pytest.raises(edge.ArgumentError, match="no such eccentric bearing with output pins fits") as refused:
        size(wish)
    # A life twice as long needs 2^(1/3) of the capacity, or a torque of so much less.
    assert offers(refused)["torque"] == pytest.approx(20.0 / 2.0 ** (1.0 / 3.0), rel=0.05)
    # Another bearing than the largest may live a little longer, never as long as was asked for.
    assert 0.9 * hours < offers(refused)["life"] < 2.0 * hours


@pytest.mark.slow(20)
def test_a_drive_with_elastic_bodies_is_sized_with_them():
    wish = Wish(**{**CNC, "outer_diameter": "90 mm", "torque": "60 N*m"})
    rigid, elastic = size(wish), size(wish.replace(bodies=True))
    limit = elastic.pair.largest_pressure.pressure
    assert elastic.pair.bodies is not None
    assert largest_pressure(elastic.pair) <= limit
    # The bodies of the drive that is sized without them would let its pressure rise above what the discs bear.
    rollers = rigid.pair.supports.output_roller.replace(stiffness=rigid.contact_stiffness)
    softer = rigid.pair.replace(bodies=rigid.bodies, supports=rigid.pair.supports.replace(output_roller=rollers))
    assert largest_pressure(rigid.pair) <= limit < largest_pressure(softer)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"ratio": 1}, "ratio = 1: one stage with the gear as output has a ratio from 2 to 300."),
        (
            {"ratio": 900},
            "ratio = 900: one stage with the gear as output has a ratio from 2 to 300; a larger one needs a "
            "first stage before it.",
        ),
        ({"material": "7075"}, 'material = "7075": did you mean 7075-T6?'),
        ({"process": "casting"}, 'process = "casting": give one of '),
        ({"torque": "0 N*m"}, 'torque = "0 N*m": it must be above zero.'),
        ({"outer_diameter": "70 m"}, 'outer_diameter = "70 m": it must be between 1 mm and 5 m.'),
        ({"life": -3600.0}, "life = -3600.0: it should be greater than 0."),
        ({"discs": 5}, "discs = 5: it should be less than or equal to 4."),
        (
            {"ring": "conjugate", "pin_material": "bronze"},
            'pin_material = "bronze": a conjugate ring has arcs of the discs\' material in place of pins.',
        ),
        (
            {"output": "ring", "bodies": True},
            "bodies needs bearings, which a drive with the ring as output does not have.",
        ),
    ],
)
def test_bad_wishes_are_refused_as_arguments_in_one_sentence(changes, message):
    with pytest.raises(edge.ArgumentError) as refused:
        Wish(**{**CNC, **changes})
    assert str(refused.value).startswith(message)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("--outer-diameter", "0.7 mm", '--outer-diameter = "0.7 mm": it must be between 1 mm and 5 m.'),
        ("--torque", "-20 N*m", '--torque = "-20 N*m": it must be above zero.'),
        ("--life", "0 h", '--life = "0 h": it should be greater than 0.'),
        ("--discs", "5", "--discs = 5: it should be less than or equal to 4."),
        ("--ratio", "1", "--ratio = 1: one stage with the gear as output has a ratio from 2 to 300."),
    ],
)
def test_the_command_names_options_as_typed(command, name, value, message):
    words = {"--ratio": "15", "--outer-diameter": "7 cm", "--torque": "20 N*m", "--material": "POM", "--process": "CNC"}
    words[name] = value
    done = command("cycloid-fmu", "new", *(word for pair in words.items() for word in pair))
    assert (done.returncode, done.stderr) == (2, message + "\n")


@pytest.mark.slow(20)
def test_the_command_names_the_option_of_a_drive_without_room_and_what_has_room(command):
    words = ["--ratio", "15", "--outer-diameter", "7 mm", "--torque", "1 N*m", "--material", "POM", "--process", "CNC"]
    done = command("cycloid-fmu", "new", *words)
    said = done.stderr.splitlines()[-1]
    assert done.returncode == 2
    assert re.fullmatch(
        r'--outer-diameter = "7 mm": no pin of 1 mm or more fits 16 times inside; '
        r"[0-9.]+ mm of outer diameter would be possible\.",
        said,
    )


@pytest.mark.slow(2)
def test_the_command_writes_a_drive_that_other_commands_take(command, tmp_path):
    words = [
        *("--ratio", "15", "--outer-diameter", "70 mm", "--torque", "20 N*m", "--material", "7075-T6"),
        *("--process", "CNC", "-o", "joint"),
    ]
    done = command("cycloid-fmu", "new", *words)
    assert done.returncode == 0, done.stderr
    assert "back-driving torque" in done.stdout
    done = command("cycloid-fmu", "analyze", "joint/drive.toml")
    assert done.returncode == 0, done.stderr
    assert "above" not in done.stdout  # no note on the pressure
    assert (tmp_path / "joint" / "figures.json").exists()
