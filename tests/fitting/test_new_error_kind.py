"""The end of a new kind's path: an error defined in a file of its own is identified in measurements."""

import numpy as np
import pytest
from common import PAIR
from new_error_kind import RING_DISTORTION

import cycloid_fmu as cy
import fitting
from cycloid_fmu.errors import kinds
from cycloid_fmu.geometry.pair import parse_pair

NOISE = 0.2 / cy.ARCSEC


@pytest.fixture
def new_kind():
    kinds.register_error_kind(RING_DISTORTION)
    yield RING_DISTORTION.name
    kinds.remove_error_kind(RING_DISTORTION.name)


@pytest.mark.slow(5)
def test_a_new_kind_is_identified_and_written(new_kind, tmp_path):
    """Five waves round the ring: no wave that is fitted (of order 1 to 3) moves the transmission error as they do."""
    drive = cy.Drive(parse_pair(PAIR + '[modification]\nisometric = "-15 um"\noffset = "-40 um"\n', "p"))
    made = drive.replace(errors={new_kind: "3 um"})
    generator, angle = np.random.default_rng(5), np.linspace(0.0, 2.0 * np.pi * 39, 39 * 20, endpoint=False)

    def run(load):
        error = made.analyze(load, crank_angle=angle).transmission_error.values[0]
        output = angle / drive.pair.ratio + error + generator.normal(0.0, NOISE, angle.size)
        way = 1 if load > 0.0 else -1
        return fitting.Run(angle[::way], output[::way], load, common_zero=True, known_index=True)

    result = fitting.identify([run(load) for load in (20.0, -20.0, 200.0, -200.0)], drive, held_out=False)
    found = next(p for p in result.parameters if p.name == new_kind)
    assert found.held is None
    assert abs(found.value - 3e-6) < 3.0 * found.standard_error < 0.4e-6
    assert result.residual == pytest.approx(NOISE, rel=0.05)
    result.drive.write(tmp_path / "found.nc")
    assert cy.read_surface(tmp_path / "found.nc").errors[new_kind] == found.value
