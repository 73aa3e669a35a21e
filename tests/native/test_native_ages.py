"""The drive that ages in a native FMU: between the tables of its life it is the worn drive, and the FMU in Python."""

import dataclasses
import functools
import itertools

import numpy as np
import pytest
from c_host import COMPILER, Slave, coarse
from common import ARCSEC
from fmpy.fmi1 import FMICallException
from fmpy.validation import validate_fmu

import cycloid_fmu as cy
from cycloid_fmu.fmu.run import open_fmu
from cycloid_fmu.native import ages as ages_module
from cycloid_fmu.native import build as native_build
from cycloid_fmu.native import tables
from cycloid_fmu.native.ages import Ages, on_common_nodes
from cycloid_fmu.surfaces.surface import Ageing, surface_after
from cycloid_fmu.wear.law import WearLaw

# Tables of several states take longest to build.
pytestmark = pytest.mark.slow(20)

HOUR = 3600.0
ACCURACY, BETWEEN = 0.2 * ARCSEC, 0.5 * ARCSEC  # of the tables, and between them
ANGLES = 0.003 + 0.021 * np.arange(6)  # rad


@pytest.fixture(scope="module")
def twin(drive):
    """A drive that loses some micrometres in 600 h by the median of its forecast."""
    law = WearLaw(pins="free", coefficient="1e-18 m^2/N", largest_step="1 um")
    worn = cy.Drive(drive.pair).wear(law, "-181 N*m", 2e7, workers=1).surface
    ageing = Ageing(2e7 / (800.0 * HOUR), 300.0 * HOUR, 600.0 * HOUR, 0.8, 4.0 / 3.0)
    return cy.Drive(drive.pair, worn.replace(life=dataclasses.replace(worn.life, ageing=ageing)))


@pytest.fixture(scope="module")
def build(twin, tmp_path_factory):
    """Build for this machine with tables of a coarse accuracy; returns the FMU and what its build returns."""
    folder = tmp_path_factory.mktemp("ages")

    def one(name, **options):
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv("CC", COMPILER[0] if len(COMPILER) == 1 else "")
            patch.setattr(tables, "PROBES", 1000)
            patch.setattr(ages_module, "ACCURACY", BETWEEN)
            patch.setattr(native_build, "tables_of", functools.partial(native_build.tables_of, accuracy=ACCURACY))
            made = native_build.build_native(twin, folder / name, platforms=[native_build.this_platform()], **options)
        return folder / name, made

    return one


@pytest.fixture(scope="module")
def built(build):
    return build("twin.fmu")


def of_age(twin, age, factor=1.0):
    """The exact drive of an age."""
    turns = age * twin.surface.life.ageing.crank_turns_per_second * factor
    return cy.Drive(twin.pair, surface_after(twin.surface, turns).replace(life=None))


def at_places(slave, torque):
    found = []
    for step, angle in enumerate(ANGLES):
        slave.put(flange_a_phi=angle, flange_b_tau=torque)
        slave.fmi.doStep(0.1 * step, 0.1)
        found += slave.get("transmission_error")
    return np.array(found)


def test_between_the_states_of_its_tables_it_is_the_worn_drive(twin, built, tmp_path):
    path, made = built
    assert made.largest_error < BETWEEN + ACCURACY
    start = of_age(twin, 300.0 * HOUR).analyze(-60.0, crank_angle=ANGLES).transmission_error.values[0]
    for number, (age, factor) in enumerate(((0.0, 1.0), (100.0, 0.8), (470.0, 1.1), (600.0, 4.0 / 3.0))):
        slave = Slave(path, tmp_path / str(number))
        assert slave.get("age", "wear_factor") == [300.0 * HOUR, 1.0]
        slave.put(age=age * HOUR, wear_factor=factor)
        slave.start(flange_a_phi=ANGLES[0], flange_b_tau=60.0)
        exact = of_age(twin, age * HOUR, factor)
        for torque in (60.0, -60.0, 2.0):
            wanted = exact.analyze(torque, crank_angle=ANGLES).transmission_error.values[0]
            assert at_places(slave, torque) == pytest.approx(wanted, abs=BETWEEN + ACCURACY)
            assert torque != -60.0 or np.abs(wanted - start).max() > 3.0 * BETWEEN
        slave.put(flange_b_tau=0.0)
        slave.fmi.doStep(0.6, 0.1)
        play = exact.analyze(0.0, crank_angle=ANGLES[-1:]).backlash.item()
        assert slave.get("backlash")[0] == pytest.approx(play, abs=2.0 * (BETWEEN + ACCURACY))
        slave.fmi.terminate()
        slave.fmi.freeInstance()


def test_it_ages_as_the_fmu_in_python_does(twin, build):
    """FMI 3.0, both flanges held: the same names and limits, and torques as exact as their tables."""
    path, made = build("native.fmu", interface="compliant", fmi_version="3.0")
    assert validate_fmu(str(path)) == []
    twin.build_fmu(path.with_name("exact.fmu"), interface="compliant", fmi_version="3.0")
    stiffness, found = [], np.zeros((2, 4))
    for (i, name), (k, age) in itertools.product(
        enumerate(("native.fmu", "exact.fmu")), enumerate((0.0, 130.0, 470.0, 600.0))
    ):
        with open_fmu(path.with_name(name)) as fmu:
            one, factor = fmu.variables["age"], fmu.variables["wear_factor"]
            assert (one.valueReference, one.unit, one.min, float(one.max)) == (
                fmu.variables["age"].valueReference,
                "s",
                "0.0",
                600.0 * HOUR,
            )
            assert (one.variability, factor.variability) == (("fixed",) * 2 if i == 0 else ("tunable",) * 2)
            fmu.initialize({"age": age * HOUR, "wear_factor": 0.9, "flange_b.phi": -2.9e-4})
            found[i, k], rigid = fmu.reader(["flange_b.tau", "torsional_stiffness"])()
            stiffness.append(rigid)
    assert np.ptp(found[1]) > 3.0 * max(stiffness) * made.largest_error
    assert found[0] == pytest.approx(found[1], abs=max(stiffness) * made.largest_error)


def test_ages_beyond_the_life_are_refused_and_a_state_keeps_its_age(built, tmp_path):
    path, _ = built
    slave, other = Slave(path, tmp_path / "a"), Slave(path, tmp_path / "b")
    for name, value, low, high in (
        ("age", -1.0, "0", "2.16e+06"),
        ("age", 2.2e6, "0", "2.16e+06"),
        ("age", np.nan, "0", "2.16e+06"),
        ("wear_factor", 0.7, "0.8", "1.33333"),
        ("wear_factor", 1.4, "0.8", "1.33333"),
    ):
        with pytest.raises(FMICallException, match="status 3"):
            slave.put(**{name: value})
        assert slave.said[-1] == f"{name} = {value:g}: it must be finite and lie between {low} and {high}."
    slave.put(age=500.0 * HOUR)
    slave.start(flange_a_phi=ANGLES[0], flange_b_tau=60.0)
    for name in ("age", "wear_factor"):
        with pytest.raises(FMICallException, match="status 3"):
            slave.put(**{name: 1.0})
        assert slave.said[-1] == f"{name} can't be set after initialization."
    other.start(flange_a_phi=ANGLES[0], flange_b_tau=60.0)
    before = other.get("transmission_error")
    bytes_of = slave.fmi.serializeFMUState(slave.fmi.getFMUState())
    other.fmi.setFMUState(other.fmi.deserializeFMUState(bytes_of))
    assert other.get("age") == [500.0 * HOUR]
    assert other.get("transmission_error") == slave.get("transmission_error") != before
    slave.fmi.reset()
    assert slave.get("age") == [300.0 * HOUR]
    slave.start(flange_a_phi=ANGLES[0], flange_b_tau=60.0)
    assert slave.get("transmission_error") == before
    for one in (slave, other):
        one.fmi.terminate()
        one.fmi.freeInstance()


def test_a_damaged_table_of_the_life_is_not_taken(built, tmp_path):
    slave = Slave(built[0], tmp_path)
    for path in (tmp_path / "resources").glob("drive.table?*"):
        damaged = bytearray(path.read_bytes())
        damaged[-100] ^= 1
        path.write_bytes(damaged)
    with pytest.raises(FMICallException, match="status 3"):
        slave.put(age=600.0 * HOUR)
    assert "the table is damaged: its checksum does not fit" in slave.said[-1]
    assert slave.get("age") == [300.0 * HOUR]
    slave.fmi.freeInstance()


@pytest.fixture(scope="module")
def own(twin):
    """Tables at both ends of the life, each on nodes of its own."""
    ends = of_age(twin, 0.0), of_age(twin, 600.0 * HOUR, 4.0 / 3.0)
    return [coarse(one.pair, one.surface, ACCURACY) for one in ends]


def test_common_nodes_change_nothing_but_rounding(own):
    """Splines and Hermite's cubics refine without an error."""
    alike = on_common_nodes(own)
    assert {one.positive.load.size for one in alike} == {np.union1d(*(one.positive.load for one in own)).size}
    draw = np.random.default_rng(1)
    theta = draw.uniform(0.0, 7.0, 5000)
    torque = draw.choice([-1.0, 1.0], 5000) * 10.0 ** draw.uniform(-2.0, np.log10(450.0), 5000)
    for before, after in zip(own, alike, strict=True):
        wanted, found = (tables.interpolated(one, theta, torque) for one in (before, after))
        step = after.positive.steps[0][0]
        assert np.abs(found.deviation - wanted.deviation).max() < 2.0 * step
        allowed = ACCURACY / tables.ACCURACY * tables.STIFFNESS_SHARE
        assert np.quantile(np.abs(found.stiffness / wanted.stiffness - 1.0), tables.MOST_STATES) < 0.5 * allowed
        assert np.abs(found.pressure / wanted.pressure - 1.0)[np.abs(torque) > 5.0].max() < 0.01


def test_more_loads_than_a_file_has_room_for_are_thinned(own, monkeypatch):
    """The kept loads are the union's without the closest ones, and only the deviation between them changes."""
    all_loads = np.union1d(*(one.positive.load for one in own))
    monkeypatch.setattr(ages_module, "MOST_LOADS", all_loads.size - 2)
    alike = on_common_nodes(own)
    kept = alike[0].positive.load
    assert kept.size == all_loads.size - 3
    assert set(kept) < set(all_loads)
    assert kept[[0, -1]] == pytest.approx(all_loads[[0, -1]])
    for before, after in zip(own, alike, strict=True):
        wanted, found = (tables.interpolated(one, np.full(kept.size, 0.3), kept) for one in (before, after))
        assert np.abs(found.deviation - wanted.deviation).max() < 2.0 * after.positive.steps[0][0]


def test_a_bearing_wears_beside_the_flanks(twin, drive, build, tmp_path, monkeypatch):
    """Four tables: the FMU's deviation is bilinear in crank turns worn and in the clearance."""
    rate, growth = twin.surface.life.ageing.crank_turns_per_second, 1e-6 / (600.0 * HOUR)

    def corner(offset, radius):
        surface = drive.surface.replace(offset=offset, pin_radius=radius)
        return coarse(drive.pair, surface, ACCURACY)

    corners = on_common_nodes([corner(a, b) for a, b in itertools.product((0.0, -3e-6), (0.0, -2e-6))])
    life = rate * 800.0 * HOUR
    made = Ages(np.array([0.0, life]), np.array([0.0, 1e-6]), rate, growth, corners, 0.0)
    monkeypatch.setattr(native_build, "ages_of", lambda *given: made)
    path, _ = build("bearing.fmu")
    slave = Slave(path, tmp_path)
    slave.put(age=200.0 * HOUR, wear_factor=0.9)
    slave.start(flange_a_phi=ANGLES[0], flange_b_tau=40.0)
    wanted = np.zeros(ANGLES.size)
    shares = 200.0 * 0.9 / 800.0, 200.0 / 600.0
    for one, (i, j) in zip(corners, itertools.product((0, 1), (0, 1)), strict=True):
        weight = (shares[0] if i else 1.0 - shares[0]) * (shares[1] if j else 1.0 - shares[1])
        wanted += weight * tables.interpolated(one, ANGLES, np.full(ANGLES.size, 40.0)).deviation
    assert at_places(slave, 40.0) == pytest.approx(wanted, abs=corners[0].positive.steps[0][0])
    slave.fmi.freeInstance()
