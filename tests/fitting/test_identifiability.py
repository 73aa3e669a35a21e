"""Separation by measurements: the bench from the drive, plans, curves with faults, and drawn surfaces."""

import dataclasses
import itertools
import re

import numpy as np
import pytest
from common import BENCH, EXAMPLES
from sampled_drives import LOADS, SMALL, random_drive, recorded

import fitting
from cycloid_fmu.analysis import error_sensitivity, solve
from cycloid_fmu.drive import Drive
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.geometry.pair import Pair, read_pair
from cycloid_fmu.surfaces.files import read_surface, write_surface
from cycloid_fmu.surfaces.structured import structured_value
from cycloid_fmu.surfaces.surface import surface_of_pair
from fitting.estimation import starts
from fitting.estimation.ensemble import ensemble
from fitting.estimation.identify import identify, kept_back
from fitting.estimation.plan import plan, planned_curve
from fitting.model.discs import other_descriptions

ARCSEC = np.pi / 648000


@pytest.fixture(scope="module")
def found(measured, nominal):
    return identify(measured(1, loads=(20.0, -20.0, 100.0, -100.0, 200.0, -200.0), zeros=(0.0,) * 6), Drive(nominal))


def test_a_load_is_kept_back_and_predicted_at_the_noise_level(found):
    assert found.held_out.loads == "+100 N·m, -100 N·m"
    assert found.held_out.residual < 1.2 * found.held_out.noise


def test_what_is_kept_back(measured):
    six = measured(1, loads=(20.0, -20.0, 100.0, -100.0, 200.0, -200.0), zeros=(0.0,) * 6)
    assert kept_back(six) == (2, 3)
    assert kept_back(six[:2] + six[4:]) == (0,)
    assert kept_back(six[:2]) == ()


@pytest.mark.slow(2)
def test_encoder_eccentricity_is_the_bench_s(measured, nominal, made):
    """Once a turn of the output belongs to no gear error, once a turn of the crank nearly so."""
    curves = measured(5)
    for i, c in enumerate(curves):
        angle = c.input_angle
        added = 20 * ARCSEC * np.cos(angle / 39 - 0.4) + 15 * ARCSEC / 39 * np.sin(angle)
        curves[i] = dataclasses.replace(c, transmission_error=c.transmission_error + added)
    found = identify(curves, Drive(nominal))
    assert found.bench["output_encoder_eccentricity_cos"] == pytest.approx(20 * ARCSEC * np.cos(0.4), abs=0.1 * ARCSEC)
    assert found.bench["output_encoder_eccentricity_sin"] == pytest.approx(20 * ARCSEC * np.sin(0.4), abs=0.1 * ARCSEC)
    truth = surface_of_pair(made)
    far = [
        abs(p.value - structured_value(truth, p.name)) / p.standard_error for p in found.parameters if p.held is None
    ]
    assert max(far) < 4.0


def test_orders_of_pins_and_teeth_are_their_own(nominal):
    """Pin errors move output orders 39 k only, tooth errors 40 k only, at first order (docs/theory/errors.md)."""
    names = ["pin_radial_2_cos", "pin_tangential_3_sin", "tooth_cumulative_pitch_1_cos", "tooth_cumulative_pitch_2_sin"]
    samples = 80
    angle = np.arange(39 * samples) * 2.0 * np.pi / samples
    columns = error_sensitivity(DriveValue.as_stated(nominal), 100.0, angle, names)[1]
    for name, column in zip(names, columns.T, strict=True):
        amplitude = np.abs(np.fft.rfft(column))[1:1200]
        own = 39 if name.startswith("pin") else 40
        orders = np.arange(1, 1200)
        # At the mesh's own order both families meet.
        assert (amplitude[(orders % own != 0) & (orders < 1100)] < 1e-6 * amplitude.max()).all(), name


@pytest.mark.slow(1)
def test_outliers_are_left_out_and_missing_arcs_do_not_matter(measured, nominal, made):
    curves = measured(6)
    error = curves[0].transmission_error.copy()
    error[[10, 200, 700]] += 300 * ARCSEC
    curves[0] = dataclasses.replace(curves[0], transmission_error=error)
    keep = np.r_[0:300, 420:936]
    names = ("input_angle", "transmission_error", "standard_error", "sample_count")
    curves[2] = dataclasses.replace(curves[2], **{n: getattr(curves[2], n)[keep] for n in names})
    found = identify(curves, Drive(nominal))
    assert [*found.outliers.values()] == [3, 0, 0, 0]
    assert any("3 of 936 points" in n for n in found.notes)
    truth = surface_of_pair(made)
    far = [
        abs(p.value - structured_value(truth, p.name)) / p.standard_error for p in found.parameters if p.held is None
    ]
    assert max(far) < 4.0


def test_notes_say_what_the_curves_lack(measured, nominal):
    one = identify(measured(7, loads=(200.0,)), Drive(nominal))
    assert any("one load" in n for n in one.notes)
    assert any("one sign" in n for n in one.notes)
    assert one.held_out is None


@pytest.mark.parametrize(("each", "said"), [pytest.param(6, True, marks=pytest.mark.slow(6)), (24, False)])
def test_too_few_crank_angles_for_the_pins_scatter_are_said(nominal, each, said):
    """Four curves in step with the crank see four times as many angles as a turn has samples, for 40 displacements."""
    changed = {"gear_teeth": 19, "pins": 20, "pin_circle_radius": 55e-3, "pin_radius": 4e-3, "eccentricity": 1.8e-3}
    pair = nominal.replace(**changed)
    generator, surface = np.random.default_rng(0), surface_of_pair(pair)
    scattered = dataclasses.replace(
        surface, pin_radial=generator.normal(0.0, 2e-6, 20), pin_tangential=generator.normal(0.0, 2e-6, 20)
    )
    curves = []
    for load in (20.0, -20.0, 200.0, -200.0):
        one = planned_curve(pair.ratio, load, 1 if load > 0.0 else -1, 1.0, each)
        error = solve(DriveValue(pair, scattered), load, one.input_angle, with_play=False).transmission_error[0]
        noisy = error + generator.normal(0.0, 0.5 * ARCSEC, error.size)
        curves.append(dataclasses.replace(one, transmission_error=noisy, source=f"{load:g}"))
    found = identify(curves, Drive(pair), held_out=False)
    # Those of which the fit finds some: radial and tangential ones, or one of both.
    few = rf"The curves contain {4 * each} crank angles in total, too few for the [24]0 displacements"
    assert any(re.match(few, n) and re.search("at least (8|15) samples a crank turn", n) for n in found.notes) == said
    assert said or not any("crank angles in total" in n for n in found.notes)


@pytest.mark.slow(3)
def test_a_curve_with_more_noise_than_the_others_is_named(measured, nominal):
    curves = measured(3, each=12)
    louder = np.random.default_rng(0).normal(0.0, 1.0 * ARCSEC, curves[1].input_angle.size)
    curves[1] = dataclasses.replace(curves[1], transmission_error=curves[1].transmission_error + louder)
    found = identify(curves, Drive(nominal), held_out=False)
    assert [n.split(":")[0] for n in found.notes if "its noise is" in n] == ["-20 N·m"]


@pytest.mark.slow(22)
def test_curves_of_another_gear_are_not_explained(measured):
    """The same ratio, another eccentricity and pin: the fit reports it and still ends."""
    other = read_pair(BENCH / "pair.toml")
    other = other.replace(eccentricity=0.7e-3)
    found = identify(measured(8, each=12), Drive(other), held_out=False)
    assert found.verdict.state == "not explained"
    assert any("Is this the drive of the pair file" in n for n in found.notes)
    assert any("Is the crank at pin 0" in n and 'zero_reference = "incremental"' in n for n in found.notes)


@pytest.mark.slow(6)
def test_starts_that_end_apart_are_said(measured, nominal, monkeypatch):
    """Where no two starts agree others are tried, the best is taken, and the fit reports the consequence."""
    monkeypatch.setattr(starts, "_AGREE", -np.inf)
    said = []
    found = identify(measured(8, each=12), Drive(nominal), progress=said.append, held_out=False)
    tried = sum(step.startswith("finding a start") for step in said)
    assert tried > 10
    assert any(f"No two of {tried} starts ended in the same optimum" in n for n in found.notes)
    assert f"no two of {tried} starts reached the same optimum" in found.verdict.sentence
    assert found.residual < 0.6 * ARCSEC


def test_more_runs_tell_no_less():
    pair = read_pair(EXAMPLES / "drive-39-40.toml")
    plans = plan(Drive(pair), [20.0, 200.0], turns=1.0, samples=12, noise=0.5 * ARCSEC, scatter=0.3e-6)
    assert [p.runs for p in plans] == ["200 N·m forward", "200 N·m both ways", "200 and 20 N·m both ways"]
    assert len(plans[0].standard_error) < len(plans[1].standard_error) <= len(plans[2].standard_error)
    for name, error in plans[1].standard_error.items():
        assert plans[2].standard_error.get(name, 0.0) < 1.01 * error
    assert "has no effect" in plans[2].held["misalignment_xz"]


@pytest.mark.slow(3)
def test_a_plan_foretells_the_fit(measured, nominal):
    """The standard errors that a plan states are those that the fit of such runs then has (no scatter in either).

    The fit can't know that pins are as thick as one another, which widens orders of the pins by a third.
    """
    found = identify(measured(9), Drive(nominal), held_out=False)
    planned = plan(Drive(nominal), [20.0, 200.0], turns=1.0, samples=24, noise=0.5 * ARCSEC, scatter=1e-9)[-1]
    ratios = {
        p.name: p.standard_error / planned.standard_error[p.name]
        for p in found.parameters
        if p.held is None and p.name in planned.standard_error
    }
    assert len(ratios) > 15
    assert np.median([*ratios.values()]) == pytest.approx(1.0, abs=0.4)
    # The cost of a flank form of 1 µm, a factor of ten, is part of both.
    for name in ("eccentricity", "pin_radius"):
        (one,) = (p for p in found.parameters if p.name == name)
        assert one.form > 0.9 * one.standard_error
        # The fit adds the shift that its own curves suggest, whose noise looks somewhat like form.
        assert 0.6 < ratios[name] < 1.7


@pytest.mark.slow(3)
def test_ensemble_have_the_fit_s_covariance(found, nominal, tmp_path):
    write_surface(found.surface, tmp_path / "s.nc")
    surface = read_surface(tmp_path / "s.nc")
    drawn, again = ([d.surface for d in ensemble(Drive(nominal, surface), count, seed=1)] for count in (400, 2))
    assert again[1].centre_distance_x == drawn[1].centre_distance_x
    at = surface.covariance_of.index("centre_distance_x")
    spread = np.std([s.centre_distance_x for s in drawn])
    assert spread == pytest.approx(np.sqrt(surface.covariance[at, at]), rel=0.15)
    write_surface(drawn[0], tmp_path / "d.nc")
    assert read_surface(tmp_path / "d.nc").attributes["ensemble_number"] == 0


def test_the_ensemble_s_band_is_as_wide_as_the_fit_is_uncertain(found, nominal, made):
    """At a load that was not measured the truth is within a few widths of the drawn band."""
    angles = np.linspace(0.0, 200.0, 40)
    drawn = [
        solve(DriveValue(nominal, s), 60.0, angles, with_play=False).transmission_error[0]
        for s in (d.surface for d in ensemble(found.drive, 60, seed=0))
    ]
    truth = solve(DriveValue.as_stated(made), 60.0, angles, with_play=False).transmission_error[0]
    centre, width = np.mean(drawn, axis=0), np.std(drawn, axis=0)
    assert np.abs((truth - centre) / width).max() < 5.0
    assert width.max() < 1.0 * ARCSEC


@pytest.mark.slow(2)
def test_plan_and_ensemble_from_the_command_line(command, found, nominal, tmp_path):
    (tmp_path / "pair.toml").write_text(nominal.text)
    write_surface(found.surface, tmp_path / "s.nc")
    run = command(
        "cycloid-fit",
        "plan",
        "pair.toml",
        "--torque",
        "20 N*m",
        "--torque",
        "200 N*m",
        "--samples",
        "12",
        "--plot",
        "p.png",
    )
    assert run.returncode == 0, run.stderr
    assert "C: 200 and 20 N·m both ways; next " in run.stdout
    assert "pin_radial, each [µm]" in run.stdout
    run = command(
        "cycloid-fit", "ensemble", "s.nc", "--pair", "pair.toml", "-o", "drawn", "--draws", "3", "--plot", "b.png"
    )
    assert run.returncode == 0, run.stderr
    assert len(list((tmp_path / "drawn").iterdir())) == 3
    assert (tmp_path / "b.png").stat().st_size > 10000, "drawn at the rated torque"
    for words, said in (
        (("plan", "pair.toml", "--torque", "-20 N*m"), '--torque = "-20 N*m": it must be above zero'),
        (
            ("ensemble", "drawn/s-0000.nc", "--pair", "pair.toml", "-o", "again"),
            "--pair has no covariance of a fit",
        ),
        (
            ("ensemble", "s.nc", "--pair", "pair.toml", "-o", "again", "--torque", "20 N*m"),
            "--torque is only for --plot",
        ),
    ):
        run = command("cycloid-fit", *words)
        assert run.returncode == 2
        assert said in run.stderr
    assert not (tmp_path / "again").exists()


@pytest.mark.parametrize(("gear_teeth", "discs"), [(11, 2), (11, 3), (9, 2)])
def test_a_drive_seen_from_another_disc_makes_the_same_curves(gear_teeth, discs):
    pair = Pair(
        gear_teeth=gear_teeth,
        pin_circle_radius=0.064,
        pin_radius=0.003,
        eccentricity=0.003,
        face_width=0.01,
        discs=discs,
    )
    random = np.random.default_rng(1)
    surface = surface_of_pair(pair)
    drawn = {
        n: random.normal(0.0, 2e-6, surface.errors[n].shape)
        for n in ("pin_radial", "pin_tangential", "pin_radius_deviation", "tooth_cumulative_pitch")
    }
    surface = surface.replace(
        **drawn, centre_distance_x=8e-6, centre_distance_y=-1e-5, misalignment_xz=1e-4, misalignment_yz=2e-4
    )
    angle = np.linspace(0.0, 2.0 * np.pi * gear_teeth, 200)
    loads = [20.0, -60.0]
    made = solve(DriveValue(pair, surface), loads, angle, 5, with_play=False).transmission_error
    others = other_descriptions(pair, surface)
    assert len(others) == discs - 1
    for other in others:
        again = solve(DriveValue(pair, other), loads, angle, 5, with_play=False).transmission_error
        assert np.abs(again - made).max() < 1e-8 * np.ptp(made)


@pytest.mark.slow(4)
def test_two_discs_without_tooth_errors_have_two_descriptions(nominal):
    """One of them contains the truth, the other its mirror image; the first line reports that there are two."""
    pair, generator = nominal.replace(discs=2, **SMALL), np.random.default_rng(1)
    surface, values = random_drive(pair, generator, 0.3e-6)
    surface = surface.replace(tooth_cumulative_pitch=np.zeros((2, pair.gear_teeth)))
    values = {n: 0.0 if n.startswith("tooth") else v for n, v in values.items()}
    runs = [recorded(pair, surface, load, generator, each=24.0, turns=2) for load in LOADS]
    found = identify(runs, Drive(pair))
    assert "2 sets of errors make these curves" in found.verdict.sentence
    (other,) = found.other_descriptions
    fitted = [p for p in found.parameters if p.held is None]
    off = [
        [abs(v[p.name] - values.get(p.name, 0.0)) / p.standard_error for p in fitted]
        for v in ({p.name: p.value for p in fitted}, other)
    ]
    near, far = sorted(off, key=np.max)
    assert np.max(near) < 4.0
    assert np.max(far) > 4.5


@pytest.mark.slow(4)
@pytest.mark.parametrize(
    ("friction", "wind_up", "hysteresis", "rounding"),
    [
        (1.0, 0.0, 0.0, 0.0),
        (1.0, 0.0, 0.0, 1e-15),
        (1.0, 0.0, 0.0, -1e-15),
        (1.0, 0.0, 0.0, 2e-15),
        (4.0, 0.0, 0.0, 0.0),
        (2.0, 3e-6, 3e-6, 0.0),
    ],
    ids=str,
)
def test_friction_wind_up_and_hysteresis_of_a_bench_are_separated(friction, wind_up, hysteresis, rounding):
    """Both directions at loads of both signs; N·m, rad/(N·m) and rad at up to 100 N·m.

    A first step that leaves the curves of the smallest load must not be taken: rounding of the angles, rad, would
    decide where the fit ends.
    """
    pair = Pair(gear_teeth=9, pin_circle_radius=0.04, pin_radius=0.004, eccentricity=0.002, face_width=0.01)
    drive = Drive(pair)
    made, angle = drive.replace(errors={"eccentricity": "3 um"}), np.linspace(0.0, 18.0 * np.pi, 120)
    generator, runs = np.random.default_rng(0), []
    for load, way in itertools.product((20.0, -20.0, 60.0, -60.0, 100.0, -100.0), (1, -1)):
        error = made.analyze(load + friction * way, crank_angle=angle).transmission_error.values[0]
        beside = wind_up * load + hysteresis * way + generator.normal(0.0, 1e-6, angle.size)
        runs.append(
            fitting.Run(
                input_angle=angle[::way],
                output_angle=angle[::way] / -9 + error[::way] + beside + rounding,
                torque=load,
                common_zero=True,
                known_index=True,
            )
        )
    found = identify(runs, drive, held_out=False)
    assert found.bench["friction_torque"] == pytest.approx(friction, rel=0.03)
    assert found.bench["chain_compliance"] == pytest.approx(wind_up, rel=0.01, abs=3e-8)
    assert found.bench["output_angle_hysteresis"] == pytest.approx(hysteresis, abs=2e-7)
    eccentricity = next(p for p in found.parameters if p.name == "eccentricity")
    assert eccentricity.value == pytest.approx(3e-6, abs=0.2e-6)
