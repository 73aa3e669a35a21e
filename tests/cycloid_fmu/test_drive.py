"""A drive is its values: however it was made, changed, written and read, it is the same drive or refused."""

import json
import pickle
import re
import zipfile

import numpy as np
import pytest
from common import CASES, DATA, PAIR, draws
from hypothesis import given, settings
from hypothesis import strategies as st

import cycloid_fmu as cy
from cycloid_fmu import edge
from cycloid_fmu.errors.kinds import KINDS, kinds_of
from cycloid_fmu.geometry.pair import parse_pair, read_pair
from cycloid_fmu.surfaces.files import read_surface, write_surface
from cycloid_fmu.surfaces.surface import Life, check_surface

SIZES = {"gear_teeth": 11, "pin_circle_radius": 55e-3, "pin_radius": 4e-3, "eccentricity": 2.1e-3, "face_width": 0.012}
UNITS = {"m": (("m", 1), ("mm", 1e-3), ("um", 1e-6)), "rad": (("rad", 1), ("mrad", 1e-3), ("arcsec", np.pi / 648000))}


@st.composite
def written(draw, value, unit):
    """A value as a user may give it: the number, or text in one of its units."""
    shown, scale = draw(st.sampled_from((*UNITS[unit], ("", 0))))
    return value if not scale else f"{value / scale!r} {shown}"


SUPPORTS = (
    None,
    {"kind": "cranks", "count": 3, "circle_radius": "30 mm", "turning_arm": {"stiffness": "400 N/um"}},
    {"kind": "output_rollers", "count": 4, "circle_radius": 0.03, "output_roller": {"stiffness": 2e8}},
)


@st.composite
def stated_errors(draw, pair):
    """Some kinds of error that a pair can have, each in one of the forms that it may have."""
    found = {}
    kinds = [kind for kind in kinds_of(pair).values() if pair.supports is None or kind.unit == "m" or kind.of_supports]
    amount = st.floats(-9e-6, 9e-6, allow_subnormal=False)
    for kind in draw(st.lists(st.sampled_from(kinds), unique_by=lambda k: k.name, max_size=5)):
        *rows, count = (1, *kind.shape(pair))
        if kind.of == "drive":
            found[kind.file_key] = draw(written(draw(amount), kind.unit))
        elif kind.of_supports:
            lists = st.lists(amount, min_size=count, max_size=count)
            each = len(rows) > 1
            found[kind.file_key] = draw(st.lists(lists, min_size=rows[-1], max_size=rows[-1]) if each else lists)
        elif draw(st.booleans()):
            orders = draw(st.lists(st.integers(1, 4), min_size=1, max_size=3, unique=True))
            found[kind.file_key] = {k: (draw(amount), draw(st.floats(-3.0, 3.0))) for k in orders}
        else:
            found[kind.file_key] = draw(st.lists(amount, min_size=count, max_size=count))
    return found


@draws(
    6,
    20,
    3,
    supports=st.sampled_from(SUPPORTS),
    offset=st.floats(-9e-5, 0.0),
    discs=st.integers(1, 2),
    data=st.data(),
)
def test_the_same_values_are_the_same_drive_however_it_was_made(tmp_path_factory, supports, offset, discs, data):
    folder = tmp_path_factory.mktemp("drive")
    pair = cy.Pair(**SIZES, discs=discs, modification={"offset": offset}, supports=supports)
    errors = data.draw(stated_errors(pair))
    whole = cy.Drive(cy.Pair(**SIZES, discs=discs, modification={"offset": offset}, errors=errors, supports=supports))
    # Changed in steps from another, in any order.
    other = cy.Drive(cy.Pair(**{**SIZES, "eccentricity": "2.0 mm"}, supports=supports))
    for key in data.draw(st.permutations(list(errors))):
        if discs == 1:
            other = other.replace(errors={key: errors[key]})
    other = other.replace(offset=offset, eccentricity="2.1 mm") if discs == 1 else None
    # Written and read: as a pair file, by its canonical text, and as a surface beside the nominal pair.
    whole.write(folder / "drive.toml")
    whole.write(folder / "surface.nc")
    (folder / "text.toml").write_text(whole.text)
    (folder / "nominal.toml").write_text(whole.pair.nominal.text)
    made = [
        cy.read_drive(folder / "drive.toml"),
        cy.read_drive(folder / "text.toml"),
        cy.read_drive(folder / "nominal.toml", folder / "surface.nc"),
        pickle.loads(pickle.dumps(whole)),
        *([other] if other is not None else []),
    ]
    for drive in made:
        assert (drive == whole, drive.hash, drive.text, drive.surface) == (True, whole.hash, whole.text, whole.surface)
        assert (drive.pair.nominal, drive.pair.nominal.hash) == (whole.pair.nominal, whole.pair.nominal.hash)
        check_surface(whole.pair, drive.surface, "a", "b")


@given(st.sampled_from(sorted(SIZES)), st.floats(1e-4, 2e-2), stated_errors(cy.Pair(**SIZES)))
@settings(max_examples=20)
def test_another_drive_is_another_and_its_surface_is_refused(name, share, errors):
    drive = cy.Drive(cy.Pair(**SIZES, errors=errors))
    if name == "gear_teeth":
        changed = cy.Pair(**{**SIZES, "gear_teeth": 10})
    else:
        changed = drive.pair.replace(**{name: getattr(drive.pair, name) * (1.0 - share)})
    assert changed.text != drive.pair.text
    assert changed.hash != drive.pair.hash
    with pytest.raises(edge.InputError, match=rf"b: this surface belongs to another pair: \[pair\] {name} is"):
        check_surface(changed, drive.surface, "a", "b")
    with pytest.raises(edge.InputError, match="another pair"):
        cy.Drive(changed, drive.surface)
    if name != "gear_teeth":
        assert cy.Drive(changed) != drive


@given(st.sampled_from([k for k in KINDS.values() if k.of == "drive"]), st.floats(1e-9, 1e-5))
def test_a_changed_error_is_another_drive(kind, amount):
    drive = cy.Drive(cy.Pair(**SIZES))
    changed = drive.replace(errors={kind.name: amount})
    assert changed != drive
    assert changed.hash != drive.hash
    assert changed.replace(errors={kind.name: 0.0}) == drive


def test_values_are_validated_the_same_in_python_and_in_files():
    """N1: there is no documented way around the validation of a file."""
    pair = parse_pair(PAIR, "pair.toml")
    for change in ({"eccentricity": 1.7e-3}, {"pin_radius": "9 mm"}, {"gear_teeth": 3}, {"face_width": -1.0}):
        (name,) = change
        for way in (pair.replace, lambda **c: pair.model_copy(update=c), cy.Drive(pair).replace):
            with pytest.raises(edge.InputError, match=name.replace("gear_teeth", "(pins|gear_teeth)")):
                way(**change)
    with pytest.raises(edge.InputError, match="did you mean pin_radius"):
        pair.replace(errors={"pin_radus": 1e-6})
    with pytest.raises(edge.InputError, match="between -1 mm and 1 mm"):
        pair.replace(errors={"pin_radius": 5e-3})
    with pytest.raises(edge.InputError, match="offset"):
        pair.replace(offset="-30 kg")
    with pytest.raises(AttributeError):
        cy.Drive(pair).pair = pair
    drive = cy.Drive(pair)
    for call, said in (
        (lambda: drive.analyze("20 kg"), 'torque = "20 kg": the unit "kg" measures something else'),
        (lambda: drive.analyze([20, float("nan")]), "torque = nan: give a finite number"),
        (lambda: drive.sensitivity(100, ["pin_radus"]), 'errors = "pin_radus": no structured error; did you mean'),
        (lambda: drive.study(cy.Tolerances(pin_radius={"tolerance": "1 um"})), "torque is missing"),
        (lambda: drive.write("drive.csv"), "path = drive.csv: the name must end in .toml or .nc"),
        (lambda: drive.build_fmu("d.fmu", interface="stiff"), 'interface = "stiff": it must be one of'),
    ):
        with pytest.raises(edge.InputError, match=re.escape(said)):
            call()


def test_a_dataset_states_the_drive_that_was_computed():
    """N1: a changed face width used to be computed and the file's text stated."""
    drive = cy.Drive(parse_pair(PAIR, "p")).replace(face_width="20 mm", errors={"pin_radius": "-1 um"})
    data = drive.analyze(100.0, angles=4)
    again = parse_pair(data.attrs["pair"], "dataset")
    assert again.face_width == 0.02
    assert cy.Drive(again) == drive
    assert data.attrs["drive"] == drive.hash


def test_an_error_surface_is_validated_against_its_pair():
    """H8: three pins for a 40-pin pair were a broadcast traceback, 5 mm were accepted."""
    pair = parse_pair(PAIR, "p")
    for values, said in (
        ({"pin_radial": [1e-6, 2e-6, 3e-6]}, r"pin_radial has the shape \(3,\); the pair needs \(40,\)"),
        ({"offset": 5e-3}, "offset reaches 5 mm"),
        ({"misalignment_xz": 0.1}, "misalignment_xz reaches 100 mrad"),
        ({"pin_radius": float("nan")}, "pin_radius holds a value that is not finite"),
        ({"gear_deviation": np.zeros((1, 38, 5, 1))}, "gear_deviation has 38 of tooth; the pair needs 39"),
        ({"pin_deviation": np.full((40, 5, 1), 1e-3)}, "pin_deviation reaches 1 mm"),
        ({"gear_curvature": np.zeros((1, 39, 5, 1))}, "curvatures need all of"),
        ({"pin_radus": 1e-6}, "did you mean pin_radius"),
        ({"origin": "guessed"}, 'origin = "guessed"'),
    ):
        with pytest.raises(edge.InputError, match=said):
            cy.ErrorSurface(pair, **values)
        with pytest.raises(edge.InputError, match=said):
            cy.ErrorSurface(pair).replace(**values)


def test_surfaces_are_comparable_and_can_not_be_written_to():
    pair = parse_pair(PAIR, "p")
    one, other = (cy.ErrorSurface(pair, pin_radial=np.full(40, v)) for v in (1e-6, 2e-6))
    assert one == one.replace(pin_radial=np.full(40, 1e-6))
    assert one != other
    assert (one == 3) is False
    assert len({one, other, one.replace(pin_radius=0.0)}) == 2
    with pytest.raises(ValueError, match="read-only"):
        one.pin_radial[0] = 1.0
    flanks, pins = np.zeros((1, 39, 4, 1)), np.zeros((40, 4, 1))
    worn = dict(gear_deviation=flanks, pin_deviation=pins, gear_curvature=flanks, pin_curvature=pins)
    states = {name: np.stack([values, values]) for name, values in worn.items()}
    life = Life(np.array([0.0, 1e6]), **states)
    assert one.replace(**worn, life=life) != one.replace(**worn)
    with pytest.raises(edge.InputError, match="must grow from 0"):
        one.replace(**worn, life=Life(np.array([1.0, 1e6]), **states))


def test_files_of_the_first_version_are_read_and_match(tmp_path):
    """A surface file whose pair is the text of a file: comments, other units, errors of its own."""
    first = read_surface(DATA / "first-version" / "surface.nc")
    pair = read_pair(DATA / "first-version" / "pair.toml")
    check_surface(pair, first, "pair.toml", "surface.nc")
    made = cy.Drive(pair, first).surface
    for name, values in cy.Drive(pair).surface.errors.items():
        assert made.errors[name] == pytest.approx(values, rel=1e-15, abs=0.0), name
    write_surface(first, tmp_path / "now.nc")
    assert read_surface(tmp_path / "now.nc") == first


@pytest.mark.parametrize("case", sorted(p.stem for p in CASES.glob("*.toml")))
def test_a_drive_and_its_canonical_text_are_solved_alike(case):
    drive = cy.read_drive(CASES / f"{case}.toml")
    again = cy.Drive(parse_pair(drive.text, "again"))
    assert again.hash == drive.hash
    one, two = (d.analyze(100.0, angles=3, turns=1) for d in (drive, again))
    assert (one.transmission_error.values == two.transmission_error.values).all()


def test_an_fmu_states_the_drive_that_it_was_built_from(tmp_path, command):
    drive = cy.read_drive(CASES / "errors-39-40.toml").replace(errors={"eccentricity": "2 um"})
    drive.build_fmu(tmp_path / "d.fmu")
    said = command("cycloid-fmu", "inspect", "d.fmu", "--json")
    assert json.loads(said.stdout)["drive"] == drive.hash
    assert drive.hash in command("cycloid-fmu", "inspect", "d.fmu").stdout
    with zipfile.ZipFile(tmp_path / "d.fmu") as archive:
        text = archive.read("documentation/drive.toml").decode()
    assert cy.Drive(parse_pair(text, "d.fmu")) == drive
