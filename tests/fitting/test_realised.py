"""Every pin and every tooth of this ring: gauge, intervals, and how near they come to the truth."""

import numpy as np
import pytest
from common import study_size
from realised_rings import figures_of, ring, rms
from sampled_drives import ARCSEC, SMALL

import fitting
from cycloid_fmu.analysis import sensitivity
from cycloid_fmu.drive import Drive
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.edge import json_table
from cycloid_fmu.surfaces.structured import displacement_columns, with_structured
from cycloid_fmu.surfaces.surface import surface_of_pair
from fitting.estimation.ensemble import ensemble
from fitting.estimation.realised import (
    displaced,
    displaced_covariance,
    errors_by_pattern,
    gauge,
    realised,
)
from fitting.model.observations import scatter_columns, spread_of, with_scatter
from fitting.reports.ring import ring_panel

DISCS = {"discs": 2, "gear_teeth": 11, "pins": 12, "pin_circle_radius": 50e-3, "pin_radius": 5e-3, "eccentricity": 2e-3}


@pytest.fixture(scope="module")
def small(nominal):
    return nominal.replace(**SMALL)


@pytest.fixture(scope="module")
def one_ring(small):
    return ring(small, 1, loads=(20.0, -20.0, 60.0, -60.0), turns=2)


@pytest.mark.parametrize("changes", [SMALL, DISCS], ids=["one disc", "two discs"])
def test_what_the_gauge_removes_other_errors_and_the_output_s_zero_do(nominal, changes):
    """By derivatives of the exact model at a scattered drive: shift, radial mean and both turns move the curves so."""
    pair, generator = nominal.replace(**changes), np.random.default_rng(3)
    directions = gauge(pair)
    scatter = np.zeros(spread_of(pair, {}).size)
    scatter[: len(directions)] = generator.normal(0.0, 2e-6, len(directions))
    surface = with_scatter(surface_of_pair(pair), scatter)
    angle = np.linspace(0.0, 2.0 * np.pi * pair.gear_teeth, 97, endpoint=False)
    others = ["pin_circle_radius", "pin_radius", "centre_distance_x", "centre_distance_y"]
    each = sensitivity(DriveValue(pair, surface), 60.0, angle).by_displacement
    columns = each @ displacement_columns(pair, others)
    does = scatter_columns(pair, each)[:, : len(directions)] @ directions
    size = np.sqrt(pair.pins)
    np.testing.assert_allclose(does[:, 0] * size, columns[:, 0], rtol=0, atol=1e-6 * np.abs(columns[:, 0]).max())
    np.testing.assert_allclose(does[:, 3] * size, columns[:, 1], rtol=0, atol=1e-6 * np.abs(columns[:, 1]).max())
    np.testing.assert_allclose(does[:, 4:] * size, -columns[:, 2:], rtol=0, atol=2e-4 * np.abs(columns[:, 2]).max())
    # A rotation of all pins, or of all teeth, turns the output, except for the change of the crank's angle.
    for turned in (does[:, 1], does[:, 2]):
        assert np.ptp(turned) < 5e-3 * np.abs(turned.mean())


def test_a_shifted_turned_and_larger_ring_has_the_same_pins(small):
    surface = with_structured(surface_of_pair(small), {"pin_radial_2_cos": 3e-6, "pin_tangential_1_sin": 1e-6})
    moved = with_scatter(surface, gauge(small) @ [4e-6, -3e-6, 2e-6, 1e-6, 5e-6, -1e-6])
    np.testing.assert_allclose(displaced(small, moved), displaced(small, surface), atol=1e-18)
    larger = with_structured(moved, {"pin_circle_radius": 7e-6})
    np.testing.assert_allclose(displaced(small, larger), displaced(small, surface), atol=1e-18)


def test_every_pin_and_tooth_of_a_ring_is_within_its_interval_and_as_near_as_the_data_allow(one_ring):
    found, distance, bound = one_ring
    assert found.verdict.state == "explained"
    figures = figures_of(found, distance, bound).values()
    assert sum(inside for *_, inside, _ in figures) >= 0.85 * distance.size
    assert rms(distance) < 1.5 * rms(bound)
    # An order of this ring is known far better than the mean of rings that scatter as much.
    errors = {p.name: p.standard_error for p in found.parameters if p.held is None}
    for name in ("pin_radial_2", "pin_tangential_2", "tooth_cumulative_pitch_2"):
        (amplitude,) = (p for p in found.realised.orders if p.name == f"{name}_amplitude")
        assert amplitude.standard_error < 0.2 * errors[f"{name}_cos"]


@pytest.mark.parametrize("scatter", [0.1e-6, 3e-6])
def test_a_pin_that_no_curve_shows_is_held_and_no_other(small, scatter):
    """Each pin and tooth known to 0.02 µm but two, and orders that nothing else determines."""
    chosen = [f"pin_radial_{k}_{w}" for k in (2, 3) for w in ("cos", "sin")]
    waves = np.zeros((47, 4))
    angle = 2.0 * np.pi * np.arange(12) / 12
    waves[:12] = np.array([wave(k * angle) for k in (2, 3) for wave in (np.cos, np.sin)]).T
    seen = np.delete(np.hstack([waves, np.eye(47)]), [5, 30], axis=0) / 0.02e-6
    spread = np.full(47, scatter)
    covariance = np.linalg.inv(seen.T @ seen + np.diag([*np.full(4, 1e6), *spread**-2]))
    found = realised(DriveValue.as_stated(small), chosen, covariance, spread)
    held = [one.name for one in found.elements if one.held]
    assert held == ["pin_radial_at_5", "tooth_cumulative_pitch_at_6"]


def test_orders_are_those_of_the_elements(one_ring):
    found, _, _ = one_ring
    for name, part in found.realised.circles.items():
        values = np.array([one.value for one in found.realised.elements[part]])
        waves = np.fft.rfft(values) * 2.0 / values.size
        stated = {p.name: p.value for p in found.realised.orders if p.name.startswith(name)}
        for order in (1, 2, 5):
            given = stated[f"{name}_{order}_amplitude"] * np.exp(-1j * stated[f"{name}_{order}_phase"])
            assert given == pytest.approx(waves[order], abs=1e-15)


@pytest.mark.slow(2)
def test_the_surface_says_the_same(one_ring, small):
    """Drives drawn from the identified surface's covariance scatter, pin by pin, with the standard errors."""
    found, _, _ = one_ring
    lever = found.realised.radius_lever
    drawn = np.array([displaced(small, one.surface, lever) for one in ensemble(found.drive, 400)])
    stated = np.array([one.standard_error for one in found.realised.elements])
    np.testing.assert_allclose(drawn.std(axis=0) / stated, 1.0, atol=0.15)
    surface = found.surface
    chosen = [n for n in surface.covariance_of if "_at_" not in n]
    again = displaced_covariance(small, chosen, surface.covariance, lever)
    np.testing.assert_allclose(again, found.realised.covariance, rtol=1e-9, atol=1e-30)
    np.testing.assert_allclose(
        displaced(small, surface, lever), [one.value for one in found.realised.elements], atol=1e-18
    )


def test_file_picture_and_report_have_every_pin_and_tooth(one_ring, tmp_path):
    found, _, _ = one_ring
    found.write(tmp_path / "fit.json")
    written = json_table(tmp_path / "fit.json", "cycloid-identification/1", "identification")["realised"]
    assert list(written["elements"]) == [one.name for one in found.realised.elements]
    assert written["elements"]["pin_radial_at_3"]["interval"] == list(found.realised.elements[3].interval)
    assert len(written["gauge"]) == 4
    assert "pin_tangential_2_phase" in written["orders"]
    fitting.plot(found.realised, tmp_path / "ring.png")
    fitting.report(found, tmp_path / "fit.html")
    text = (tmp_path / "fit.html").read_text(encoding="utf-8")
    one = found.realised.elements[3]
    assert f"{one.value * 1e6:.3f}\u00a0±\u00a0{1.96 * one.standard_error * 1e6:.3f}" in text
    assert any(trace.label == "95 % interval" for trace in ring_panel(found.realised).traces)


def test_without_an_explanation_the_intervals_are_withheld_and_not_drawn(one_ring):
    found, _, _ = one_ring
    withheld = found.realised.withheld()
    assert all(np.isnan(one.interval).all() for one in (*withheld.elements, *withheld.orders))
    assert not any(trace.style == "thick" for trace in ring_panel(withheld).traces)


def test_a_plan_foretells_pins_and_teeth_and_the_run_that_helps(one_ring, small):
    """The standard errors of the fit of such runs; none is worse, each as good as a plan with it predicts."""
    found, _, _ = one_ring
    runs = {"turns": 2.0, "noise": 0.5 * ARCSEC, "scatter": 2e-6}
    forward, *_, last = fitting.plan(Drive(small), [20.0, 60.0], **runs)
    for name, error in errors_by_pattern(small, found.realised.covariance).items():
        assert last.realised[name] == pytest.approx(error, rel=0.35)
    for plan in (forward, last):
        assert all(one.realised[name] <= plan.realised[name] for one in plan.next_runs for name in plan.realised)
    assert forward.next_runs[0].run.endswith("backward")
    both = fitting.plan(Drive(small), [60.0], **runs)[1]
    (other,) = (one for one in forward.next_runs if one.run == "60 N·m backward")
    for name, error in both.realised.items():
        assert other.realised[name] == pytest.approx(error, rel=0.1)


@pytest.mark.slow(20)
def test_pins_and_teeth_of_random_rings(nominal, record_property):
    """Half of CYCLOID_SEEDS rings of 39/40: 2 µm in places of pins and teeth, 0.3 µm in radii, 0.5″."""
    rings = max(1, study_size("CYCLOID_SEEDS", 5, 200) // 2)
    figures = {}
    for number in range(rings):
        for name, one in figures_of(*ring(nominal, number)).items():
            figures.setdefault(name, []).append(one)
    for name, every in figures.items():
        distance, bound, inside, count = np.array(every).T
        covered = inside.sum() / count.sum()
        said = (
            f"{rms(distance) * 1e6:.3f} µm rms, {rms(distance) / rms(bound):.2f} bounds, {covered:.3f} of {rings} rings"
        )
        record_property(f"realised {name}", said)
        limit = {"tooth_cumulative_pitch": 0.05e-6, "pin_radius_deviation": 0.3e-6}.get(name, 0.10e-6)
        assert rms(distance) < limit, (name, said)
        assert rms(distance) < 1.5 * rms(bound), (name, said)
        assert rings < 20 or 0.92 <= covered <= 0.98, (name, said)
