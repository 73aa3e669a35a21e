"""Forces and pressures of single pins from FMUs of tables, which hold none: native and in Python, FMI 3.0."""

import dataclasses
import functools
import re
import struct
from pathlib import Path
from types import SimpleNamespace

import brute_force
import fmpy
import numpy as np
import pytest
from c_host import COMPILER, HERE, INTERFACES, compiled, needs, pins_of
from common import ARCSEC, EXAMPLES, PAIR
from fmpy.fmi3 import FMU3Slave
from fmpy.validation import validate_fmu

from cycloid_fmu import reducer as rv
from cycloid_fmu.fmu import native_build, tables
from cycloid_fmu.fmu.build import build_fmu
from cycloid_fmu.fmu.compliant_model import CompliantModel
from cycloid_fmu.fmu.core import Core
from cycloid_fmu.fmu.model import DriveModel
from cycloid_fmu.fmu.reducer_model import ReducerModel
from cycloid_fmu.geometry.pair import parse_pair, read_pair
from cycloid_fmu.surfaces.surface import nominal_surface, surface_of_pair

MODIFIED = "[modification]\n" + 'isometric = "-15 um"\noffset = "-40 um"\n'
TEXT = PAIR + 'rated_torque = "181 N*m"\n' + MODIFIED


class Slave:
    """A native FMI 3.0 FMU in fmpy."""

    def __init__(self, path, folder):
        description = fmpy.read_model_description(str(path))
        self.references = {v.name: v.valueReference for v in description.modelVariables}
        (self.shape,) = (v.shape for v in description.modelVariables if v.name == "pin_force")
        self.said = []
        self.fmi = FMU3Slave(
            guid=description.instantiationToken, unzipDirectory=fmpy.extract(str(path), unzipdir=str(folder)),
            modelIdentifier=description.coSimulation.modelIdentifier, instanceName="drive",
        )  # fmt: skip
        self.fmi.instantiate()
        self.fmi.enterInitializationMode()

    def start(self, **values):
        self.put(**values)
        self.fmi.exitInitializationMode()

    def put(self, **values):
        for name, value in values.items():
            name = name.replace("flange_a_", "flange_a.").replace("flange_b_", "flange_b.")
            (self.fmi.setBoolean if name == "backlash_on" else self.fmi.setFloat64)([self.references[name]], [value])

    def at(self, angle, torque):
        self.put(flange_a_phi=angle, flange_b_tau=torque)
        self.fmi.doStep(0.0, 1e-3)

    def pins(self):
        """Force (N) and pressure (Pa) of all pins, shape (2, discs, pins)."""
        both = [self.references[name] for name in ("pin_force", "pin_pressure")]
        return np.reshape(self.fmi.getFloat64(both, nValues=2 * int(np.prod(self.shape))), (2, *self.shape))

    def state(self):
        state = self.fmi.getFMUState()
        data = bytes(self.fmi.serializeFMUState(state))
        self.fmi.freeFMUState(state)
        return data


def built(folder, pair, surface, made, kind="kinematic", stage=None):
    path = folder / "drive.fmu"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CC", COMPILER[0] if len(COMPILER) == 1 else "")
        native_build.build_native(
            pair, surface, path, INTERFACES[kind], "3.0", stage, made=made, platforms=[native_build.this_platform()]
        )
    return path


@pytest.fixture
def opened(tmp_path):
    """A native FMU of a drive, instantiated."""
    made = []

    def one(*drive, **more):
        folder = tmp_path / str(len(made))
        folder.mkdir()
        made.append(Slave(built(folder, *drive, **more), folder / "unpacked"))
        return made[-1]

    yield one
    for each in made:
        each.fmi.freeInstance()


def pins_of_model(model):
    return np.reshape([model.pin_force, model.pin_pressure], (2, model.pair.discs, model.pair.pins))


def moved(model, angle, torque):
    model.crank_angle, model.torque = angle, torque
    model.advance()
    return pins_of_model(model)


@functools.cache
def without_errors(text):
    """Coarse tables of a drive without errors, which repeat from pin to pin and are soon made."""
    pair = parse_pair(text, "drive.toml")
    return tables.compute(pair, nominal_surface(pair), accuracy=0.3 * ARCSEC)


def scattered(pair, **more):
    """A surface whose pins and teeth all differ, by 2 µm, and with the given errors."""
    random, surface = np.random.default_rng(5), nominal_surface(pair)
    names = ("pin_radial", "pin_tangential", "pin_radius_deviation", "tooth_cumulative_pitch")
    drawn = {name: 2e-6 * random.normal(size=getattr(surface, name).shape) for name in names}
    return dataclasses.replace(surface, centre_distance_x=3e-6, eccentricity=-2e-6, **drawn, **more)


def rough(pair, width, **more):
    """The same with a deviation of 1 µm of every element of flanks and pins."""
    random, g = np.random.default_rng(6), pair
    return scattered(
        pair, gear_deviation=random.normal(0.0, 1e-6, (g.discs, g.gear_teeth, 60, width)),
        pin_deviation=random.normal(0.0, 1e-6, (g.pins, 50, width)), **more,
    )  # fmt: skip


def worn(pair):
    """Likewise, and a curvature of every element, up to one that leaves none between flank and pin."""
    random, surface = np.random.default_rng(7), rough(pair, 2)
    curvatures = {
        f"{body}_curvature": random.normal(0.0, 150.0, getattr(surface, f"{body}_deviation").shape)
        for body in ("gear", "pin")
    }
    return dataclasses.replace(surface, **curvatures)


TILTED = {"misalignment_xz": 3e-4, "misalignment_yz": -1e-4}
DRIVES = {
    "no errors": ({}, nominal_surface),
    "all pins and teeth differ": ({}, scattered),
    "law as printed": ({"contact_law": "as_printed"}, scattered),
    "two discs": ({"discs": 2}, scattered),
    "ring": ({"output": "ring"}, scattered),
    "two discs, ring": ({"discs": 2, "output": "ring"}, scattered),
    "misaligned": ({}, lambda pair: scattered(pair, **TILTED)),
    "rough": ({}, lambda pair: rough(pair, 1)),
    "rough, misaligned, ring": ({"output": "ring"}, lambda pair: rough(pair, 3, **TILTED)),
    "rough, two discs": ({"discs": 2}, lambda pair: rough(pair, 2)),
    "worn": ({}, worn),
}


@pytest.mark.parametrize("name", DRIVES)
def test_they_are_the_exact_model_s_and_not_the_tables(opened, name, record_property):
    """From tables of the drive without errors: only crank angle and torque are those of the drive with them."""
    keys, surfaced = DRIVES[name]
    text = TEXT
    for key, value in keys.items():
        text = text.replace(
            "[pair]\n", f'[pair]\n{key} = "{value}"\n' if key != "discs" else f"[pair]\n{key} = {value}\n"
        )
    pair = parse_pair(text, "drive.toml")
    surface, made = surfaced(pair), without_errors(text)
    native, exact = opened(pair, surface, made), DriveModel(pair, surface)
    in_python = DriveModel(pair, surface, tables=tables.interpolation(made))
    native.start()
    random, worst = np.random.default_rng(8), 0.0
    for i in range(60):
        angle = random.uniform(-60.0, 60.0)
        torque = random.choice([-1.0, 1.0]) * (
            random.uniform(5.0, 450.0) if i % 3 else 10.0 ** random.uniform(-1.0, 1.0)
        )
        wanted = moved(exact, angle, torque)
        native.at(angle, torque)
        most = wanted.max(axis=(1, 2))[:, None, None]
        assert (most > 0.0).all()
        worst = max(worst, (np.abs(native.pins() - wanted) / most).max())
        assert worst <= 1e-5
        assert (np.abs(moved(in_python, angle, torque) - wanted) <= 1e-5 * most).all()
    record_property(f"native pin forces, {name}, largest error", f"{worst:.1e} of the most loaded pin's")


@pytest.fixture(scope="module")
def as_made():
    """The drive as made, its errors in coarse tables."""
    pair = read_pair(EXAMPLES / "drive-39-40-as-made.toml")
    surface = surface_of_pair(pair)
    return pair, surface, tables.compute(pair, surface, accuracy=1.0 * ARCSEC)


def test_force_times_arm_is_the_torque_by_brute_force(opened, as_made):
    """Arms of contacts that are looked for by bisection, at the output's place that balances the torque there."""
    native = opened(*as_made)
    native.start()
    read, random = brute_force.load_pair(EXAMPLES / "drive-39-40-as-made.toml"), np.random.default_rng(9)
    for torque in (-181.0, -30.0, 60.0, 440.0):
        angle = random.uniform(0.0, 30.0)
        native.at(angle, torque)
        force, pressure = native.pins()
        slow = brute_force.solve(read, angle, torque, with_play=False)
        every = brute_force.Pair(read, angle, 200).contacts(slow["transmission_error"])
        arms = np.zeros(40)
        arms[every.pin[every.gap < 0.0]] = every.arm[every.gap < 0.0]
        assert force[0] @ arms == pytest.approx(torque, rel=1e-5)
        assert force == pytest.approx(slow["pin_force"], abs=1e-4 * force.max())
        assert pressure.max() == pytest.approx(slow["max_contact_pressure"], rel=1e-4)
        assert native.fmi.getInt32([native.references["contact_count"]])[0] == pytest.approx(
            slow["contact_count"], abs=1
        )


def test_in_the_play_no_pin_is_pressed(opened, as_made):
    native, exact = opened(*as_made), DriveModel(*as_made[:2])
    native.start()
    for i, torque in enumerate((150.0, 0.0, 0.0, -80.0, 0.0)):
        wanted = moved(exact, 0.01 * i, torque)
        native.at(0.01 * i, torque)
        assert (native.pins() == 0.0).all() == (torque == 0.0) == (wanted == 0.0).all()


def test_friction_holds_pins_pressed_that_nothing_loads(opened, drive):
    native, exact = opened(drive.pair, drive.surface, drive.tables), DriveModel(drive.pair, drive.surface)
    native.start(friction_torque=20.0)
    exact.friction_torque = 20.0
    exact.advance()
    for i, torque in enumerate((150.0, 135.0, 120.0, 0.0, 0.0, -15.0, -90.0, -60.0, 0.0)):
        wanted = moved(exact, 1e-4 * i, torque)
        native.at(1e-4 * i, torque)
        assert wanted.max() > 0.0
        # While it holds the torque is found from the output's place, which the tables know to 0.02″.
        assert (np.abs(native.pins() - wanted) <= 5e-3 * wanted.max(axis=(1, 2))[:, None, None]).all()


@pytest.mark.parametrize("torque", [0.0, 1e-4, -40.0])
def test_with_interference_pins_press_without_a_torque(opened, torque):
    pair = parse_pair(PAIR + 'rated_torque = "180 N*m"\n[modification]\noffset = "3 um"\n', "pressed.toml")
    surface = surface_of_pair(pair)
    made = tables.compute(pair, surface, accuracy=0.3 * ARCSEC)
    native, exact = opened(pair, surface, made), DriveModel(pair, surface)
    in_python = DriveModel(pair, surface, tables=tables.interpolation(made))
    native.start()
    for angle in np.linspace(0.0, 7.0, 20):
        wanted = moved(exact, angle, torque)
        native.at(angle, torque)
        most = wanted.max(axis=(1, 2))[:, None, None]
        assert most[0, 0, 0] > 10.0
        assert (np.abs(native.pins() - wanted) <= 1e-5 * most).all()
        assert (np.abs(moved(in_python, angle, torque) - wanted) <= 1e-5 * most).all()


def test_an_rv_reducer_s_pins_stand_where_its_first_stage_turns_the_crank(opened):
    whole = rv.read_reducer(EXAMPLES / "rv-20e.toml")
    pair, stage = whole.stage, rv.first_stage_of(whole)
    surface = nominal_surface(pair)
    made = tables.compute(pair, surface, accuracy=0.3 * ARCSEC)
    native, exact = opened(pair, surface, made, stage=stage), ReducerModel(pair, surface, stage)
    in_python = ReducerModel(pair, surface, stage, tables=tables.interpolation(made))
    native.start()
    random = np.random.default_rng(10)
    for torque in (120.0, -30.0, 3.0, -200.0, 0.0, 90.0):
        angle = random.uniform(-900.0, 900.0)
        wanted = moved(exact, angle, torque)
        native.at(angle, torque)
        # The crank's torque, which the tables give, takes some of the flange's from the gears.
        assert native.pins() == pytest.approx(wanted, abs=1e-3 * wanted[0].max() + 1e-9, rel=2e-3)
        assert native.pins() == pytest.approx(moved(in_python, angle, torque), rel=1e-6, abs=1e-6)


@pytest.mark.parametrize("kind", ["compliant", "inertia"])
def test_between_flanks_they_carry_the_torque_of_the_flange(opened, drive, kind):
    native = opened(drive.pair, drive.surface, drive.tables, kind=kind)
    exact = CompliantModel(drive.pair, drive.surface, output_inertia=INTERFACES[kind].output_inertia)
    ratio, random = drive.pair.ratio, np.random.default_rng(11)
    if kind == "inertia":
        native.start(flange_b_tau=80.0)
        exact.torque = 80.0
        exact.forget_history()
        exact.advance()
        assert native.pins() == pytest.approx(pins_of_model(exact), rel=5e-3)
        return
    native.start()
    for off in (2.4e-4, -2.2e-4, 2.0e-4, 1e-5, -2.6e-4):
        crank = random.uniform(-9.0, 9.0)
        native.put(flange_a_phi=crank, flange_b_phi=crank / ratio + off)
        native.fmi.doStep(0.0, 1e-3)
        exact.crank_angle, exact.output_angle = crank, crank / ratio + off
        exact.advance(1e-3)
        wanted = pins_of_model(exact)
        assert (wanted.max() > 0.0) == (abs(off) > 1e-4)
        # By the tables' error of 0.02″ the torque, and so the forces, differ from the exact flanks'.
        assert native.pins() == pytest.approx(wanted, abs=5e-3 * wanted[0].max() + 1e-9, rel=5e-3)


def test_they_are_there_before_the_first_step(opened, drive):
    native, exact = opened(drive.pair, drive.surface, drive.tables), DriveModel(drive.pair, drive.surface)
    native.put(flange_a_phi=0.7, flange_b_tau=90.0)
    wanted = moved(exact, 0.7, 90.0)
    assert native.pins() == pytest.approx(wanted, rel=1e-4, abs=1e-5 * wanted[0].max())
    native.fmi.exitInitializationMode()
    assert native.pins() == pytest.approx(wanted, rel=1e-4, abs=1e-5 * wanted[0].max())


def test_to_ask_for_them_changes_nothing(opened, drive):
    asked, quiet = (opened(drive.pair, drive.surface, drive.tables) for _ in range(2))
    random = np.random.default_rng(12)
    for each in (asked, quiet):
        each.start(friction_torque=3.0)
    for _ in range(50):
        angle, torque = random.normal(0.0, 5.0), random.choice([0.0, 1.0]) * random.normal(0.0, 100.0)
        for each in (asked, quiet):
            each.at(angle, torque)
        before = asked.state()
        first = asked.pins()
        assert (asked.pins() == first).all()
        assert asked.state() == before == quiet.state()


def test_the_fmu_in_python_has_the_same_arrays(opened, drive, tmp_path):
    path = tmp_path / "tables.fmu"
    build_fmu(
        drive.pair, drive.surface, path, interface=INTERFACES["kinematic"], fmi_version="3.0", tables=drive.tables
    )
    assert validate_fmu(str(path)) == []
    native = opened(drive.pair, drive.surface, drive.tables)
    asked, quiet = (Core(resources(path, tmp_path / name), "3.0") for name in ("asked", "quiet"))
    v = {variable.name: reference for reference, variable in asked.table.items()}
    assert v == native.references
    for each in (native, asked, quiet):
        each.start()
    for angle, torque in ((1.0, 120.0), (2.0, -60.0), (2.1, 0.0), (2.1, 30.0)):
        native.at(angle, torque)
        for each in (asked, quiet):
            each.put_all([v["flange_a.phi"], v["flange_b.tau"]], [angle, torque])
            assert each.step(0.0, 1e-3) == ""
        found = np.array([asked.getters[v[name]]() for name in ("pin_force", "pin_pressure")])
        assert found == pytest.approx(native.pins().reshape(2, -1), rel=1e-6, abs=1e-6)
        others = [reference for name, reference in v.items() if not name.startswith("pin_")]
        assert [asked.getters[r]() for r in others] == [quiet.getters[r]() for r in others]
        quiet.restore(asked.state())
        assert (found == [quiet.getters[v[name]]() for name in ("pin_force", "pin_pressure")]).all()


def resources(path, folder):
    return Path(fmpy.extract(str(path), unzipdir=str(folder))) / "resources"


# --- the C host, and tables that no builder writes ---


@pytest.fixture(scope="module")
def rough_fmu(tmp_path_factory):
    """An unpacked FMU of a drive with a deviation and a curvature of every element."""
    folder = tmp_path_factory.mktemp("rough")
    pair = parse_pair(TEXT, "drive.toml")
    path = built(folder, pair, worn(pair), without_errors(TEXT))
    description = fmpy.read_model_description(str(path))
    fmpy.extract(str(path), unzipdir=str(folder / "unpacked"))
    return SimpleNamespace(
        folder=folder / "unpacked", version="3.0", kind="kinematic", uri=f"{folder / 'unpacked' / 'resources'}/",
        guid=description.instantiationToken,
        library=folder / "unpacked" / "binaries" / "x86_64-linux" / "CycloidDrive.so",
    )  # fmt: skip


@pytest.mark.parametrize("kind", INTERFACES)
def test_the_c_host_gets_the_same_bits_whatever_was_asked_before(unpacked, host, kind):
    fmu = unpacked(kind, "3.0")
    said = host(fmu, "pins", 500, *pins_of(fmu))
    pressed, refused = map(int, re.search(r"pressed in (\d+), (\d+) refused", said).groups())
    assert pressed > 50
    assert refused == 0


def test_contacts_with_a_right_hash_and_wrong_numbers_are_refused_or_solved(unpacked, host, tmp_path, rough_fmu):
    random = np.random.default_rng(13)
    for fmu, most in ((unpacked("kinematic", "3.0"), 40), (rough_fmu, 15)):
        data = (fmu.folder / "resources" / "drive.table").read_bytes()
        problem = struct.pack("<7I", 1, 1, 39, 0, 0, 0, 0)
        begin = data.rindex(problem) - 8 if fmu is not rough_fmu else data.rindex(struct.pack("<4I", 1, 2, 39, 0)) - 8
        for i in range(most):
            changed = bytearray(data)
            # Counts and scalars stand first; all else is numbers.
            for place in random.integers(begin, begin + 124 if i % 2 else len(data), 3):
                changed[place] = random.integers(256)
            struct.pack_into("<Q", changed, 24, tables.fnv1a(bytes(changed[32:])))
            (tmp_path / "drive.table").write_bytes(changed)
            assert host(fmu, "pins", 5, *pins_of(fmu), uri=f"{tmp_path}/", fails=None) in (0, 1)


@pytest.mark.slow
@needs("gcc")
def test_contacts_with_deviations_are_clean_under_the_sanitizers(rough_fmu, host, tmp_path):
    flags = ("-O1", "-fsanitize=address,undefined", "-fno-sanitize-recover=all", "-fno-omit-frame-pointer")
    native = HERE.parents[1] / "cycloid_fmu" / "fmu" / "native"
    library = compiled(
        tmp_path / "drive.so", [native / name for name in native_build.SOURCES], *flags, "-shared", "-fPIC"
    )
    program = compiled(tmp_path / "host", [HERE / "host.c"], "-DFMI=3", *flags)
    assert "0 refused" in host(rough_fmu, "pins", 200, *pins_of(rough_fmu), program=program, library=library)


@pytest.mark.slow
@needs("valgrind")
def test_contacts_with_deviations_are_clean_under_valgrind(rough_fmu, host):
    valgrind = ("valgrind", "--quiet", "--error-exitcode=9", "--leak-check=full", "--errors-for-leak-kinds=definite")
    assert "0 refused" in host(rough_fmu, "pins", 20, *pins_of(rough_fmu), prefix=valgrind)
