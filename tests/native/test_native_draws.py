"""Draws of an identification in a native FMU: each has tables of its own, read where it is chosen."""

import functools

import numpy as np
import pytest
from c_host import COMPILER, Slave
from common import ARCSEC
from fmpy.fmi1 import FMICallException
from fmpy.validation import validate_fmu

import cycloid_fmu as cy
import fitting
from cycloid_fmu.fmu.run import open_fmu
from cycloid_fmu.native import build as native_build
from cycloid_fmu.native import tables

ACCURACY = 0.2 * ARCSEC
TORQUE, ANGLE = 60.0, 0.7  # N·m, rad


@pytest.fixture(scope="module")
def identified(drive):
    """The drive with a covariance of errors that leave its pins alike, so that its tables are soon made."""
    covariance = np.array([[4e-12, 1e-12], [1e-12, 1e-12]])
    return cy.Drive(drive.pair, drive.surface.replace(covariance=covariance, covariance_of=("eccentricity", "offset")))


@pytest.fixture(scope="module")
def build(drive, identified, tmp_path_factory):
    """Build with two draws for this machine, their tables of a coarse accuracy."""
    folder = tmp_path_factory.mktemp("draws")

    def one(name, **options):
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv("CC", COMPILER[0] if len(COMPILER) == 1 else "")
            patch.setattr(tables, "PROBES", 1000)
            kept = functools.partial(native_build.tables_of, accuracy=ACCURACY)
            patch.setattr(native_build, "tables_of", kept)
            native_build.build_native(
                identified,
                folder / name,
                draws=2,
                seed=1,
                made=drive.tables,
                platforms=[native_build.this_platform()],
                **options,
            )
        return folder / name

    return one


@pytest.fixture(scope="module")
def built(build):
    return build("drive.fmu")


def started(path, folder, draw):
    slave = Slave(path, folder)
    slave.fmi.setInteger([slave.references["draw"]], [draw])
    slave.start(flange_a_phi=ANGLE, flange_b_tau=TORQUE)
    return slave


def ended(slave):
    slave.fmi.terminate()
    slave.fmi.freeInstance()


def test_each_draw_is_the_drive_that_the_ensemble_draws(identified, built, tmp_path):
    drives = [identified, *fitting.ensemble(identified, 2, seed=1)]
    for draw, one in enumerate(drives):
        slave = started(built, tmp_path / str(draw), draw)
        (found,) = slave.get("transmission_error")
        assert slave.fmi.getInteger([slave.references["draw"]]) == [draw]
        ended(slave)
        exact = one.analyze(TORQUE, crank_angle=[ANGLE]).transmission_error.item()
        assert found == pytest.approx(exact, abs=ACCURACY)
        apart = abs(exact - identified.analyze(TORQUE, crank_angle=[ANGLE]).transmission_error.item())
        assert draw == 0 or apart > 5.0 * ACCURACY


def test_a_draw_that_is_not_there_is_refused_and_a_state_keeps_its_draw(built, tmp_path):
    slave, other = Slave(built, tmp_path / "a"), Slave(built, tmp_path / "b")
    reference = slave.references["draw"]
    for value in (-1, 3):
        with pytest.raises(FMICallException, match="status 3"):
            slave.fmi.setInteger([reference], [value])
        assert slave.said[-1] == f"draw = {value}: it must be finite and lie between 0 and 2."
    slave.fmi.setInteger([reference], [2])
    slave.start(flange_a_phi=ANGLE, flange_b_tau=TORQUE)
    with pytest.raises(FMICallException, match="status 3"):
        slave.fmi.setInteger([reference], [1])
    assert slave.said[-1] == "draw can't be set after initialization."
    state = slave.fmi.getFMUState()
    other.start(flange_a_phi=ANGLE, flange_b_tau=TORQUE)
    before = other.get("transmission_error")
    other.fmi.setFMUState(other.fmi.deserializeFMUState(slave.fmi.serializeFMUState(state)))
    assert other.fmi.getInteger([reference]) == [2]
    assert other.get("transmission_error") == slave.get("transmission_error") != before
    slave.fmi.reset()
    assert slave.fmi.getInteger([reference]) == [0]
    slave.start(flange_a_phi=ANGLE, flange_b_tau=TORQUE)
    assert slave.get("transmission_error") == before
    ended(slave)
    ended(other)


def test_tables_of_another_draw_or_damaged_ones_are_not_taken(built, tmp_path):
    folder = tmp_path / "fmu"
    slave = Slave(built, folder)
    one, two = (folder / "resources" / f"drive.table{k}" for k in (1, 2))
    damaged = bytearray(one.read_bytes())
    damaged[-100] ^= 1
    for content, said in (
        (two.read_bytes(), "this table belongs to another FMU or draw"),
        (bytes(damaged), "the table is damaged: its checksum does not fit"),
    ):
        one.write_bytes(content)
        with pytest.raises(FMICallException, match="status 3"):
            slave.fmi.setInteger([slave.references["draw"]], [1])
        assert said in slave.said[-1]
        assert slave.fmi.getInteger([slave.references["draw"]]) == [0]
    slave.fmi.freeInstance()


def test_between_two_flanges_a_draw_is_its_drive(build, identified):
    """FMI 3.0: torque and energy at flanges that are held are those of the FMU in Python."""
    path = build("compliant.fmu", interface="compliant", fmi_version="3.0")
    assert validate_fmu(str(path)) == []
    identified.build_fmu(path.with_name("exact.fmu"), interface="compliant", draws=2, seed=1)
    found = np.zeros((2, 3))
    for i, name in enumerate(("compliant.fmu", "exact.fmu")):
        for number in range(3):
            with open_fmu(path.with_name(name)) as fmu:
                draw = fmu.variables["draw"]
                assert (draw.variability, draw.min, draw.max, draw.start) == ("fixed", "0", "2", "0")
                fmu.initialize({"draw": number, "flange_b.phi": 2e-4})
                (found[i, number],) = fmu.reader(["flange_b.tau"])()
    assert np.ptp(found[1]) > 0.002 * found[1, 0]
    assert found[0] == pytest.approx(found[1], rel=2e-3)


def test_more_draws_than_there_is_room_for_are_refused(drive, identified, tmp_path, monkeypatch):
    monkeypatch.setattr(native_build, "MOST_BYTES", 300_000)
    monkeypatch.setenv("CC", COMPILER[0] if len(COMPILER) == 1 else "")
    with pytest.raises(
        cy.InputError,
        match=r"^draws = 20: tables of 0\.06\d+ MB each would take more than 0 MB; this "
        r"drive's FMU has room for 3\.$",
    ):
        native_build.build_native(
            identified, tmp_path / "drive.fmu", draws=20, made=drive.tables, platforms=[native_build.this_platform()]
        )
    assert not (tmp_path / "drive.fmu").exists()
