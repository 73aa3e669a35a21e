"""Maps over conditions, from curves whose orders, gaps and stiffness are known."""

import json

import numpy as np
import pytest
import xarray as xr
from common import ARCSEC

import fitting
from fitting.figures.maps import write_maps
from fitting.reports.maps_report import map_panels
from fitting.reports.plots import plot_panels

TURN = np.linspace(0.0, 2.0 * np.pi, 1500, endpoint=False)
STIFFNESS, GAP = 3.0e6, 30 * ARCSEC


def made(load, speed, warm, sign, noise):
    """A run of a 39/40 drive whose rig runs out by 40″; order 39 grows with the load, the gap with the temperature."""
    error = 40 * np.cos(TURN) + (5.0 + load / 100.0) * np.cos(39 * TURN) + 3.0 * np.cos(40 * TURN + 1.0)
    error = (error + noise.normal(0.0, 0.3, TURN.size)) * ARCSEC + load / STIFFNESS + 0.5 * sign * GAP * warm / 300.0
    output = -sign * TURN
    return fitting.Run(
        input_angle=(output - error) * -39,
        output_angle=output,
        torque=load,
        speed=speed,
        temperature=warm,
        common_zero=True,
        name=f"{load:g} {speed:g} {warm:g} {sign:g}",
    )


@pytest.fixture(scope="module")
def found():
    noise = np.random.default_rng(0)
    runs = [
        made(load + noise.normal(0.0, 0.1), speed, warm + noise.normal(0.0, 0.1), sign, noise)
        for load in (100.0, 200.0, 400.0)
        for speed in (1.0, 2.0)
        for warm in (300.0, 320.0)
        for sign in (1, -1)
    ]
    return fitting.maps(runs[1:], -39.0)


def test_conditions_that_scatter_are_gathered(found):
    assert found.torque.values == pytest.approx([100, 200, 400], abs=0.3)
    assert found.speed.values == pytest.approx([1, 2])
    assert found.temperature.values == pytest.approx([300, 320], abs=0.3)
    assert int(found.recordings.sum()) == 23


def test_orders_of_each_condition(found):
    for k, wanted in ((1, 40.0), (40, 3.0)):
        assert found.order_amplitude.sel(order=k).max() / ARCSEC == pytest.approx(wanted, abs=0.1)
    of39 = found.order_amplitude.sel(order=39, direction="backward").mean(("speed", "temperature")) / ARCSEC
    assert of39.values == pytest.approx([6.0, 7.0, 9.0], abs=0.1)


def test_a_rigs_run_out_is_told_apart(found):
    whole = found.angular_transmission_error.sel(direction="backward")
    drive = found.angular_transmission_error_without_rig.sel(direction="backward")
    assert float(whole.min()) / ARCSEC > 2 * 40
    # Orders 39 and 40 beat: once a turn they meet.
    assert drive.mean(("speed", "temperature")).values / ARCSEC == pytest.approx([18.0, 20.0, 24.0], abs=0.7)


def test_gap_and_stiffness(found):
    assert found.gap.mean(("torque", "speed")).values == pytest.approx(
        GAP * np.array([300.0, 320.0]) / 300.0, abs=0.1 * ARCSEC
    )
    assert found.torsional_stiffness.sel(direction="backward").values == pytest.approx(STIFFNESS, rel=0.01)
    assert np.isnan(found.torsional_stiffness.sel(direction="forward").values[0, 0, 0])
    assert np.isnan(found.gap.values[0, 0, 0])


def test_an_unknown_zero_gives_no_stiffness(found):
    runs = [
        fitting.Run(input_angle=-39 * TURN, output_angle=TURN + 1e-5 * np.cos(TURN), torque=t) for t in (10.0, 20.0)
    ]
    without = fitting.maps(runs, -39.0)
    assert without.torsional_stiffness.isnull().all()
    assert without.gap.isnull().all()
    assert "zero_reference" in without.attrs["notes"]


@pytest.mark.slow(2)
def test_maps_are_written_and_drawn(found, tmp_path):
    write_maps(found, tmp_path / "maps.nc")
    read = xr.load_dataset(tmp_path / "maps.nc")
    assert read.attrs["format"] == "cycloid-maps/1"
    xr.testing.assert_allclose(read.order_amplitude, found.order_amplitude)
    fitting.report(found, tmp_path / "maps.html")
    page = (tmp_path / "maps.html").read_text(encoding="utf-8")
    assert "heatmap" in page
    assert len(page) < 10e6
    fitting.plot(found, tmp_path / "maps.png")
    assert (tmp_path / "maps.png").stat().st_size > 20000


@pytest.mark.slow(1)
def test_maps_from_the_command_line(command, tmp_path):
    for load in (100, 200):
        error = (40 * np.cos(TURN) + load / 20 * np.cos(39 * TURN)) * ARCSEC + load / STIFFNESS
        rows = [f"{a:.8f},{e:.8f}" for a, e in zip(np.degrees(TURN), error / ARCSEC, strict=True)]
        (tmp_path / f"d_{load}Nm_10rpm_25C.csv").write_text("\n".join(["Position [deg],TE [arcsec]", *rows]))
    assert command("cycloid-fit", "inspect", "d_100Nm_10rpm_25C.csv", "-o", "m.toml").returncode == 0
    files = ["d_100Nm_10rpm_25C.csv", "d_200Nm_10rpm_25C.csv"]
    run = command(
        "cycloid-fit",
        "maps",
        *files,
        "--mapping",
        "m.toml",
        "--ratio",
        "-39",
        "-o",
        "m.nc",
        "--report",
        "m.html",
        "--plot",
        "m.png",
    )
    assert run.returncode == 0, run.stderr
    found = xr.load_dataset(tmp_path / "m.nc")
    amplitude = found.order_amplitude.sel(order=39, direction="backward").squeeze() / ARCSEC
    assert amplitude.values == pytest.approx([5.0, 10.0], abs=0.01)
    printed = command("cycloid-fit", "maps", *files, "--mapping", "m.toml", "--ratio", "-39", "--json")
    assert json.loads(printed.stdout)["torque"] == pytest.approx([100, 200])
    refused = command("cycloid-fit", "maps", *files, "--mapping", "m.toml")
    assert refused.returncode == 3
    assert "Give the drive, or its ratio" in refused.stderr


def test_a_single_condition_is_drawn_as_bars():
    """Each as long as its value; a map of one value would be a coloured rectangle."""
    noise = np.random.default_rng(1)
    one = fitting.maps([made(200.0, 1.0, 300.0, sign, noise) for sign in (1, -1)], -39.0)
    (panel,) = map_panels(one)
    assert not panel.heat
    assert panel.title == "One condition: torque 200 N·m, speed 9.549 rpm, temperature 26.85 °C"
    bars = [t for t in panel.traces if t.style == "thick"]
    assert len(bars) == len(panel.y_names) == 5 + 2 * one.order.size
    assert all(bar.x[0] == 0.0 for bar in bars)
    drawn = [line for line in plot_panels([panel]).axes[0].lines if line.get_linewidth() > 2.0]
    assert [line.get_solid_capstyle() for line in drawn] == ["butt"] * len(bars)
    lengths = {(panel.y_names[-int(bar.y[0])], bar.colour): bar.x[1] for bar in bars}
    assert lengths["order 39, input turn", 0] == pytest.approx(7.0, abs=0.1)
    assert lengths["order 40", 1] == pytest.approx(3.0, abs=0.1)
    assert lengths["gap between directions", 2] == pytest.approx(GAP / ARCSEC, abs=0.1)
    assert fitting.plot(one).axes


def test_lines_over_one_axis_begin_at_zero():
    """Also over the temperature alone: a change of two percent must not fill the axis."""
    noise = np.random.default_rng(2)
    for runs, label in (
        ([made(load, 1.0, 300.0, 1, noise) for load in (100.0, 200.0)], "torque [N·m]"),
        ([made(100.0, 1.0, warm, 1, noise) for warm in (300.0, 320.0, 340.0)], "temperature [°C]"),
    ):
        found = fitting.maps(runs, -39.0)
        panels = map_panels(found)
        assert all(p.x_label == label and not p.heat for p in panels)
        line = next(t for t in panels[0].traces if t.style == "line")
        assert line.y == pytest.approx(
            found.angular_transmission_error.sel(direction="forward").values.ravel() / ARCSEC, rel=1e-12
        )
        for axis in fitting.plot(found).axes:
            assert axis.get_ylim()[0] <= 0.0 <= axis.get_ylim()[1]
