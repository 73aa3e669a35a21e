"""Draws of an identification in a native FMU: each has tables of its own, read where it is chosen."""

import functools
import zipfile

import fmpy
import numpy as np
import pytest
from c_host import COMPILER, Slave
from common import ARCSEC

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
            patch.setenv("XDG_CACHE_HOME", str(folder))
            patch.setattr(tables, "PROBES", 1000)
            kept = functools.partial(native_build.tables_of, accuracy=ACCURACY)
            patch.setattr(native_build, "tables_of", kept)
            native_build.build_native(
                identified, folder / name, draws=2, seed=1, made=drive.tables,
                platforms=[native_build.this_platform()], **options,
            )  # fmt: skip
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
