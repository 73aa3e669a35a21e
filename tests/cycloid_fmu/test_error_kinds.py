"""A kind of error is defined once: one file takes it from TOML to the identification."""

import math

import fmpy
import numpy as np
import pytest
import xarray as xr
from common import PAIR
from new_error_kind import RING_DISTORTION, distortion

import cycloid_fmu as cy
from cycloid_fmu import edge
from cycloid_fmu.analysis import error_sensitivity, solve
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.errors import kinds
from cycloid_fmu.errors.stated import Errors
from cycloid_fmu.geometry.pair import parse_pair
from cycloid_fmu.studies import tolerance
from cycloid_fmu.surfaces.sampling import parse_tolerances
from cycloid_fmu.surfaces.structured import displacement_layout, structured_value, with_structured
from cycloid_fmu.surfaces.surface import ErrorSurface, alike, surface_of_pair

CLEARANCE = PAIR + '[modification]\nisometric = "-15 um"\noffset = "-40 um"\n'
ANGLES = np.linspace(0.0, 2.0 * np.pi, 41, endpoint=False)


@pytest.fixture
def new_kind():
    kinds.register_error_kind(RING_DISTORTION)
    yield RING_DISTORTION.name
    kinds.remove_error_kind(RING_DISTORTION.name)


def test_an_unknown_kind_is_refused_and_a_known_one_not(new_kind):
    stated = CLEARANCE + '[errors]\nring_distortion = "3 um"\n'
    assert parse_pair(stated, "p").errors.ring_distortion == pytest.approx(3e-6)
    kinds.remove_error_kind(new_kind)
    try:
        with pytest.raises(edge.InputError, match="ring_distortion is not a known key"):
            parse_pair(stated, "p")
    finally:
        kinds.register_error_kind(RING_DISTORTION)


def test_the_new_kind_is_the_pins_that_it_displaces(new_kind, tmp_path, command):
    """Transmission error from TOML through the command: bit for bit that of the pins' list of the same amounts."""
    (tmp_path / "new.toml").write_text(CLEARANCE + '[errors]\nring_distortion = "3 um"\n')
    pins = distortion(parse_pair(CLEARANCE, "p"), 3e-6)
    listed = ", ".join(f'"{value!r} m"' for value in pins.tolist())
    (tmp_path / "list.toml").write_text(CLEARANCE + f"[errors]\npin_radial = [{listed}]\n")
    for name in ("new", "list"):
        done = command("cycloid-fmu", "analyze", f"{name}.toml", "--torque", "150 N*m", "-o", f"{name}.nc")
        assert done.returncode == 0, done.stderr
    new, listed = (xr.load_dataset(tmp_path / f"{name}.nc") for name in ("new", "list"))
    error = new.transmission_error.values[0]
    assert error == pytest.approx(listed.transmission_error.values[0], abs=1e-15)
    # Five waves of 40 pins: one crank turn repeats them, so the crank meets 40 - 5 and 40 + 5 of them, minus 1 a turn.
    orders = np.abs(np.fft.rfft(error - error.mean()))[1:60]
    assert orders.argmax() + 1 in (4, 5, 6)
    assert "ring_distortion" in new.attrs["pair"]


def test_its_sensitivity_is_that_of_finite_differences(new_kind):
    pair = parse_pair(CLEARANCE, "p")
    surface, step = ErrorSurface(pair, ring_distortion=2e-6), 1e-9
    _, jacobian = error_sensitivity(DriveValue(pair, surface), 150.0, ANGLES, [new_kind])
    ends = [
        solve(
            DriveValue(pair, surface.replace(ring_distortion=2e-6 + s)), 150.0, ANGLES, with_play=False
        ).transmission_error[0]
        for s in (step, -step)
    ]
    assert jacobian[:, 0] == pytest.approx(
        (ends[0] - ends[1]) / (2 * step), rel=2e-3, abs=2e-3 * np.abs(jacobian).max()
    )


def test_it_makes_pins_unlike(new_kind):
    pair = parse_pair(CLEARANCE, "p")
    assert alike(ErrorSurface(pair)) == (True, True)
    assert alike(ErrorSurface(pair, ring_distortion=1e-6)) == (True, False)


def test_a_study_samples_it_within_its_tolerance(new_kind):
    text = 'format = "cycloid-tolerances/1"\n[ring_distortion]\ntolerance = "4 um"\n'
    study = tolerance.Study(parse_pair(CLEARANCE, "p"), parse_tolerances(text, "t"), 12, 1, (150.0,), angles=24)
    drawn = [tolerance.surface_of(study, point).ring_distortion for point in tolerance.points(study)]
    assert np.abs(drawn).max() <= 4e-6
    assert np.std(drawn) > 0.5e-6
    figures = tolerance.run(study).figure("angular_transmission_error")
    # The larger the distortion, the larger the error: a study that left it out would give twelve equal drives.
    assert np.corrcoef(np.abs(drawn), figures[:, 0] if figures.ndim > 1 else figures)[0, 1] > 0.9


def test_it_is_a_tunable_parameter_of_the_fmu(new_kind, tmp_path):
    pair = parse_pair(CLEARANCE, "p")
    cy.Drive(pair).build_fmu(tmp_path / "d.fmu")
    description = fmpy.read_model_description(str(tmp_path / "d.fmu"))
    (variable,) = (v for v in description.modelVariables if v.name == new_kind)
    assert (variable.causality, variable.variability, variable.unit) == ("parameter", "tunable", "m")
    result = fmpy.simulate_fmu(
        str(tmp_path / "d.fmu"),
        stop_time=0.01,
        step_size=0.01,
        output=["transmission_error"],
        start_values={new_kind: 3e-6, "flange_a.phi": 0.4, "flange_b.tau": 150.0},
    )
    wanted = solve(DriveValue(pair, ErrorSurface(pair, ring_distortion=3e-6)), 150.0, 0.4).transmission_error[0, 0]
    assert result["transmission_error"][-1] == pytest.approx(wanted, abs=1e-12)
    without = solve(DriveValue(pair, ErrorSurface(pair)), 150.0, 0.4).transmission_error[0, 0]
    assert abs(wanted - without) > 1e-6


def having(kind, pair):
    """The pair, with supports where an error of this kind needs them."""
    if kind.of in pair.places:
        return pair
    rollers = {"kind": "output_rollers", "output_roller": {"stiffness": 2e8}}
    held = {"kind": "cranks"} if kind.of not in ("roller", "roller_hole") else rollers
    return pair.replace(supports={"count": 3, "circle_radius": 0.03, "turning_arm": {"stiffness": 4e8}, **held})


@pytest.mark.parametrize("kind", list(kinds.KINDS.values()), ids=lambda kind: kind.name)
def test_displacements_are_linear_and_fit_where_they_go(kind):
    """The basis of the sensitivities' columns and of first order, with values of a random drive."""
    pair, generator = (
        having(kind, parse_pair(PAIR.replace("[pair]", "[pair]\ndiscs = 2"), "p")),
        np.random.default_rng(3),
    )
    layout = displacement_layout(pair)
    a, b = (generator.normal(size=kind.shape(pair)) for _ in range(2))
    for name, displacement in kind.displaces.items():
        together = np.ravel(displacement(pair, 2.0 * a - 3.0 * b))
        apart = 2.0 * np.ravel(displacement(pair, a)) - 3.0 * np.ravel(displacement(pair, b))
        assert together == pytest.approx(apart, rel=1e-12)
        assert together.size == layout[name].stop - layout[name].start


@pytest.mark.parametrize("kind", list(kinds.KINDS.values()), ids=lambda kind: kind.name)
def test_files_surfaces_and_structured_errors_agree_on_each_kind(kind):
    pair = having(kind, parse_pair(CLEARANCE, "p"))
    value = 1e-5 if kind.of == "drive" else np.full(kind.shape(pair), 1e-5).tolist()
    surface = surface_of_pair(pair.replace(errors=Errors({kind.file_key: value})))
    assert np.all(surface.errors[kind.name] == 1e-5)
    assert sum(np.any(v) for v in surface.errors.values()) == 1
    for name in kinds.structured_names([1, 2]):
        if kinds.kind_of(name) is kind:
            moved = with_structured(surface, {name: 7e-6})
            assert structured_value(moved, name) == pytest.approx(7e-6, rel=1e-12)


def test_what_it_displaces_must_exist():
    with pytest.raises(ValueError, match="must be one of"):
        kinds.register_error_kind(kinds.ErrorKind("x", "x", "x", "drive", {"nothing": distortion}))
    with pytest.raises(ValueError, match="exists"):
        kinds.register_error_kind(kinds.KINDS["pin_radius"])
    assert math.isclose(kinds.KINDS["misalignment_xz"].limit, 0.02)
