"""Orders of the transmission error, whole and not, and what averaging over turns removes, on runs of known orders."""

import dataclasses
import json

import numpy as np
import pytest
from common import study_size

from fitting.figures.metrics import figures_of
from fitting.readers.recording import Recording
from fitting.reports.figures_report import write_figures_report
from fitting.transmission_error.survey import survey

SEEDS = study_size("CYCLOID_SEEDS", 5, 100)
ARCMIN = np.pi / 10800
PULLEY = 3.34615
WHOLE = {1: (4.3, 0.3), 2: (6.5, 1.0), 15: (4.2, 2.0), 32: (3.3, 0.2)}
OTHERS = {PULLEY: (4.8, 1.0), 2 * PULLEY: (4.3, 2.0), 4 * PULLEY: (2.0, -2.0)}
TURNS = 26


def run(orders, *, turns=TURNS, each=999.7, noise=1.0, seed=0, way=1, pulley=1.0, uneven=0.3):
    """A run of orders {order: (amplitude in arcmin, phase)} of the output at an uneven speed, with white noise."""
    random = np.random.default_rng(seed)
    share = np.arange(int(turns * each)) / int(turns * each)
    psi = 2 * np.pi * turns * (share + uneven * np.sin(20 * share) / 20) * way + random.uniform(0, 6)
    error = sum(a * np.cos(k * psi + p) for k, (a, p) in orders.items()) + random.normal(0, noise, psi.size)
    n = np.ones(psi.size)
    return Recording(
        np.arange(psi.size) / 1000,
        15.0 * psi,
        psi + error * ARCMIN,
        10.0 * n,
        np.zeros(psi.size, np.uint8),
        ratio=15.0,
        source="run.csv",
        checksum="0",
        pulley=pulley,
    )


def figures(made):
    return figures_of([survey(made, 15.0, None)], 15.0, None)


@pytest.mark.parametrize("way", [1, -1])
@pytest.mark.parametrize("pulley", [-PULLEY, 1.0])
def test_orders_come_back_with_their_phases_and_causes(way, pulley):
    found = figures(run(WHOLE | OTHERS, way=way, pulley=pulley)).orders[0]
    assert found.direction == way
    assert len(found.orders) == len(WHOLE | OTHERS)
    for order, (amplitude, phase) in (WHOLE | OTHERS).items():
        one = min(found.orders, key=lambda o: abs(o.order - order))
        assert abs(one.order - order) <= 2 * one.order_uncertainty + 1e-9
        assert abs(one.amplitude / ARCMIN - amplitude) <= 2 * one.uncertainty / ARCMIN
        assert abs(np.angle(np.exp(1j * (one.phase - phase)))) <= 2 * one.phase_uncertainty
        assert one.whole == (order in WHOLE)
        if not one.whole:
            assert one.source == ("pulley" if pulley != 1.0 else "")


def test_what_averaging_removes_is_the_variance_of_the_other_orders_and_the_noise():
    """By definition: half the squared amplitudes, and the noise of a step; the range of the mean is without them."""
    found = figures(run(WHOLE | OTHERS, noise=1.0, uneven=0.0))
    averaging = found.orders[0].turn_averaging
    whole, others = (sum(a**2 for a, _ in orders.values()) / 2 for orders in (WHOLE, OTHERS))
    total = whole + others + 1.0
    assert averaging.variance_share_of_other_orders == pytest.approx(others / total, rel=0.02)
    assert averaging.variance_share_removed == pytest.approx((others + 1.0) / total, rel=0.05)
    psi = np.linspace(0, 2 * np.pi, 100000)
    mean = np.ptp(sum(a * np.cos(k * psi + p) for k, (a, p) in WHOLE.items()))
    assert averaging.peak_to_peak_of_the_mean / ARCMIN == pytest.approx(mean, rel=0.06)
    assert averaging.peak_to_peak_of_all_turns > averaging.peak_to_peak_of_one_turn > averaging.peak_to_peak_of_the_mean
    assert any("removed" in n and "no whole number: 3.346" in n for n in found.notes)


@pytest.mark.parametrize("turns", [1.3, 2.5, 6.4, 26.0])
@pytest.mark.parametrize("seeds", [2, pytest.param(SEEDS, marks=pytest.mark.slow)])
def test_a_drive_without_other_orders_has_none(turns, seeds):
    """Whole orders sampled at other angles in each turn, and noise; at most one in a hundred such runs may show one."""
    seen = 0
    for seed in range(seeds):
        found = figures(run(WHOLE | {240: (1.0, 0.0)}, turns=turns, seed=seed)).orders[0]
        seen += any(not one.whole for one in found.orders)
        assert (found.searched is None) == (turns < 5)
        assert (found.turn_averaging is None) == (turns < 2)
    assert seen <= 0.05 * seeds


def test_whole_orders_that_change_over_the_turns_are_no_others():
    made = run(WHOLE, noise=0.3)
    psi = made.input_angle / 15.0
    share = np.linspace(0, 1, psi.size)
    warmed = 2.0 * ARCMIN * np.exp(-3 * share) * np.cos(15 * psi) + 5 * ARCMIN * share
    found = figures(dataclasses.replace(made, output_angle=made.output_angle + warmed)).orders[0]
    assert all(one.whole for one in found.orders)


@pytest.mark.slow(2)
@pytest.mark.parametrize(("turns", "pulley"), [(6.4, -PULLEY), (26.0, -PULLEY), (26.0, 1.0)])
def test_intervals_of_orders_hold(turns, pulley, record_property):
    """92 to 98 of 100 intervals of amplitude and phase contain the truth, within the scatter of the seeds."""
    truth = WHOLE | OTHERS
    inside = np.zeros(2)
    for seed in range(SEEDS):
        found = figures(run(truth, turns=turns, noise=2.0, seed=seed, pulley=pulley)).orders[0].orders
        for order, (amplitude, phase) in truth.items():
            one = min(found, key=lambda o: abs(o.order - order))
            inside += (
                abs(one.amplitude / ARCMIN - amplitude) <= one.uncertainty / ARCMIN,
                abs(np.angle(np.exp(1j * (one.phase - phase)))) <= one.phase_uncertainty,
            )
    share = inside / (SEEDS * len(truth))
    record_property("share of intervals of amplitude and phase", share.tolist())
    assert (abs(share - 0.95) <= 0.03 + 2.0 * np.sqrt(0.0475 / (SEEDS * len(truth)))).all(), share


def test_the_command_prints_the_largest_orders_and_writes_all(command, tmp_path):
    made = run(WHOLE | OTHERS, each=299.7)
    rows = np.column_stack([made.time, made.input_angle, made.output_angle * PULLEY])
    np.savetxt(tmp_path / "run.csv", rows, "%.9f", ",", header="t,a,b", comments="")
    (tmp_path / "map.toml").write_text(
        'format = "cycloid-mapping/1"\nratio = 15\n[time]\ncolumn = "t"\nunit = "s"\n[input_angle]\ncolumn = "a"\n'
        f'unit = "rad"\n[output_angle]\ncolumn = "b"\nunit = "rad"\n[pulley]\nratio = {PULLEY}\n'
    )
    done = command("cycloid-fit", "metrics", "run.csv", "--mapping", "map.toml", "-o", "figures.json")
    assert done.returncode == 0, done.stderr
    assert "Largest orders" in done.stdout
    assert "pulley" in done.stdout
    assert "turns removed" in done.stderr
    ((one,),) = (json.loads((tmp_path / "figures.json").read_text())["orders"],)
    assert {o["order"] for o in one["orders"] if o["source"] == "pulley"} == {m * PULLEY for m in (1, 2, 4)}
    assert one["turn_averaging"].keys() >= {"variance_share_removed", "peak_to_peak_of_one_turn"}


@pytest.mark.slow(2)
def test_a_report_has_the_orders_that_averaging_removes(tmp_path):
    found = figures(run(WHOLE | OTHERS, pulley=-PULLEY))
    write_figures_report(found, tmp_path / "report.html")
    page = (tmp_path / "report.html").read_text()
    assert 'id="orders"' in page
    assert f"{PULLEY:.4g} pulley" in page
    write_figures_report(found, tmp_path / "report.pdf")
    assert (tmp_path / "report.pdf").stat().st_size > 10_000


@pytest.mark.parametrize("noise", [0.0, 0.05])
def test_counts_of_an_encoder_are_no_orders(noise):
    """8192 counts of a turn, which no file states: their steps make lines of up to 1/π of a count, 2.6′."""
    made = run(WHOLE, noise=noise)
    count = 2.0 * np.pi / 8192
    made = dataclasses.replace(made, output_angle=np.round(made.output_angle / count) * count)
    found = figures(made).orders[0]
    assert all(one.whole for one in found.orders)


@pytest.mark.parametrize("turns", [1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
def test_whole_turns_have_their_whole_orders(turns):
    """Three turns have no line between whole orders that shows the noise alone."""
    found = figures(run(WHOLE, turns=turns, uneven=0.0, each=1000.0)).orders[0]
    assert {one.order for one in found.orders if one.whole} >= set(WHOLE)
    assert all(one.whole for one in found.orders)
