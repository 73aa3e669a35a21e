"""Surfaces with a deviation for every element, misaligned axes, contact lines and element pressures."""

import contextlib
import dataclasses
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from common import ARCSEC, CASES, PAIR, make_pair

from cycloid_fmu import edge
from cycloid_fmu.analysis import analyze, solve, statistics
from cycloid_fmu.contact.transmission import Interrupted
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.fmu.build import build_fmu
from cycloid_fmu.fmu.run import simulate_fmu
from cycloid_fmu.geometry.pair import parse_pair, read_pair
from cycloid_fmu.surfaces.files import read_surface, write_surface
from cycloid_fmu.surfaces.surface import nominal_surface, surface_of_pair

ERRORS = read_pair(CASES / "errors-39-40.toml")
ANGLES = np.linspace(0.0, 12.0, 40)
TILTED = parse_pair(
    (CASES / "errors-39-40.toml").read_text().replace("[errors]", '[errors]\nmisalignment_xz = "0.3 mrad"'), "tilted"
)


def flanks(surface, profile, width, heights):
    """A surface with the given heights on every tooth, shape (profile, width)."""
    discs, teeth = surface.tooth_cumulative_pitch.shape
    return dataclasses.replace(surface, gear_deviation=np.broadcast_to(heights, (discs, teeth, profile, width)).copy())


@pytest.mark.parametrize("case", ["errors-39-40", "two-discs-39-40", "nearly-conformal-13-14"])
@pytest.mark.parametrize("output", ["gear", "ring"])
def test_an_even_deviation_of_the_flanks_is_an_isometric_modification(case, output):
    """Raising every element by h gives the parallel curve: the gaps are those of ΔR_rp = -h exactly."""
    pair = parse_pair((CASES / f"{case}.toml").read_text().replace("[pair]", f'[pair]\noutput = "{output}"'), case)
    surface = surface_of_pair(pair)
    wanted = solve(DriveValue(pair, dataclasses.replace(surface, isometric=surface.isometric - 2e-6)), -120.0, ANGLES)
    found = solve(DriveValue(pair, flanks(surface, 200, 3, 2e-6)), -120.0, ANGLES, 3)
    assert found.backlash == pytest.approx(wanted.backlash, abs=1e-12, nan_ok=True)
    # Only the curvature in Hertz's law differs by h.
    assert found.transmission_error == pytest.approx(wanted.transmission_error, abs=0.005 * ARCSEC)


def test_an_even_deviation_of_the_pins_is_their_radius():
    surface = surface_of_pair(ERRORS)
    wanted = solve(
        DriveValue(ERRORS, dataclasses.replace(surface, pin_radius=surface.pin_radius + 2e-6)), -120.0, ANGLES
    )
    found = solve(
        DriveValue(ERRORS, dataclasses.replace(surface, pin_deviation=np.full((40, 60, 3), 2e-6))), -120.0, ANGLES, 3
    )
    assert found.backlash == pytest.approx(wanted.backlash, abs=1e-12)
    assert found.transmission_error == pytest.approx(wanted.transmission_error, abs=0.005 * ARCSEC)


def test_one_higher_pin_of_many_elements_is_that_pin_s_radius():
    surface = nominal_surface(make_pair(PAIR + '[modification]\noffset = "-60 um"\nisometric = "-20 um"\n'))
    pair = surface.pair
    deviation, radius = np.zeros((40, 90, 2)), np.zeros(40)
    deviation[11], radius[11] = 3e-6, 3e-6
    wanted = solve(DriveValue(pair, dataclasses.replace(surface, pin_radius_deviation=radius)), 0.0, ANGLES)
    found = solve(DriveValue(pair, dataclasses.replace(surface, pin_deviation=deviation)), 0.0, ANGLES, 2)
    assert found.play_low == pytest.approx(wanted.play_low, abs=1e-12)
    assert found.play_high == pytest.approx(wanted.play_high, abs=1e-12)


def test_a_slope_across_the_face_is_a_turn_of_each_slice():
    """Two slices, heights ±h: the outer one carries first, and the play is that of the higher slice."""
    pair = parse_pair(PAIR + '[modification]\noffset = "-60 um"\nisometric = "-20 um"\n', "p")
    surface = nominal_surface(pair)
    sloped = flanks(surface, 100, 2, np.array([[-2e-6, 2e-6]]))
    wanted = solve(DriveValue(pair, dataclasses.replace(surface, isometric=-2e-6)), 0.0, ANGLES)
    found = solve(DriveValue(pair, sloped), 0.0, ANGLES, 2)
    assert found.backlash == pytest.approx(wanted.backlash, abs=1e-12)


def test_elements_converge():
    """A smooth deviation on ever finer elements: second order, and far below 0.01″ at the default 800."""
    pair = ERRORS
    surface = surface_of_pair(pair)

    def error(profile):
        arc = (np.arange(profile) + 0.5) / profile
        heights = 3e-6 * np.cos(2 * np.pi * 3 * arc)[:, None]
        return solve(
            DriveValue(pair, flanks(surface, profile, 1, heights)), -120.0, ANGLES, with_play=False
        ).transmission_error

    finest = error(3200)
    differences = [np.abs(error(n) - finest).max() / ARCSEC for n in (50, 100, 200, 400, 800)]
    assert differences[-1] < 0.01
    assert differences[0] > 4 * differences[2] > 4 * differences[4]


@pytest.mark.parametrize(("tilt", "slices"), [("0.1 mrad", 5), ("0.5 mrad", 20)])
def test_slices_converge(tilt, slices):
    """Transmission error within 0.1 % at 5 and 20 slices."""
    text = (CASES / "errors-39-40.toml").read_text().replace("[errors]", f'[errors]\nmisalignment_xz = "{tilt}"')
    pair = parse_pair(text, "tilted")
    surface = surface_of_pair(pair)
    fine = solve(DriveValue(pair, surface), -120.0, ANGLES, 200, with_play=False)
    coarse = solve(DriveValue(pair, surface), -120.0, ANGLES, slices, with_play=False)
    difference = np.abs(coarse.transmission_error - fine.transmission_error).max()
    assert difference < 1e-3 * np.abs(fine.transmission_error).max()


def test_interpolated_slices_are_the_solved_ones():
    """Many slices (clear pins interpolated) against the same slices as a surface with elements (each one solved)."""
    surface = surface_of_pair(TILTED)
    found = solve(DriveValue(TILTED, surface), -120.0, ANGLES, 40)
    solved = solve(DriveValue(TILTED, flanks(surface, 50, 1, 0.0)), -120.0, ANGLES, 40)
    assert found.transmission_error == pytest.approx(solved.transmission_error, abs=1e-11)
    assert found.backlash == pytest.approx(solved.backlash, abs=1e-12)
    assert found.pin_force == pytest.approx(solved.pin_force, rel=1e-6, abs=1e-6)


@pytest.mark.slow(2)
def test_lines_and_element_pressures():
    data = analyze(DriveValue.as_stated(TILTED), [-120.0, 60.0], np.linspace(0, 6, 60), 25, with_elements=True)
    total = data["slice_force"].sum("slice")
    assert total.values == pytest.approx(data["pin_force"].values, rel=1e-5, abs=1e-3)
    largest = data["max_contact_pressure"].max("crank_angle").values
    for name in ("gear_element_pressure", "pin_element_pressure"):
        seen = data[name].max([d for d in data[name].dims if d != "torque"]).values
        assert (seen <= largest * (1 + 1e-9)).all()
        assert seen == pytest.approx(largest, rel=0.05)  # an element's middle is not at the contact's
    assert np.abs(data["slice_direction"].values).max() < np.pi / 2
    assert data["gear_element_pressure"].dims == ("torque", "disc", "tooth", "profile", "slice")


def test_the_paper_s_contact_range():
    """Error-surface paper, figure 7: half of each flank is engaged, a pin from zero to 54.45° (arcsin K = 54.341°)."""
    pair = make_pair()
    data = analyze(
        DriveValue(pair, nominal_surface(pair)), -181.0, np.linspace(0, 2 * np.pi, 3600), 1, with_elements=True
    )
    flank = data["gear_element_pressure"].max(("torque", "disc", "tooth", "slice")).values > 0
    assert flank.mean() == pytest.approx(0.5, abs=0.01)
    assert not flank[400:].any()
    touched = data["angle"].values[data["pin_element_pressure"].max(("torque", "pin", "slice")).values > 0]
    assert np.degrees(touched.min()) == pytest.approx(-54.4, abs=0.5)
    assert np.degrees(touched.max()) == pytest.approx(0.0, abs=0.5)
    # The flank's highest pressure is where it turns from concave to convex, near the convex side.
    peak = data["gear_element_pressure"].max(("torque", "disc", "tooth", "slice")).values.argmax()
    assert 0.2 < data["profile"].values[peak] < 0.35


def test_statistics_are_the_paper_s():
    data = analyze(DriveValue.as_stated(ERRORS), [-120.0, 120.0], ANGLES)
    figures = statistics(data)
    assert figures["MTE"] == pytest.approx(data["transmission_error"].mean("crank_angle").values)
    assert figures["PPB"] == pytest.approx(np.ptp(data["backlash"].values, axis=1))
    assert figures["MCS"] == pytest.approx(data["max_contact_pressure"].max("crank_angle").values)


def test_the_number_of_workers_changes_no_bit():
    surface = surface_of_pair(TILTED)
    angles = np.linspace(0, 6, 900)
    one, two = (solve(DriveValue(TILTED, surface), [-120.0, 0.0], angles, 10, workers=n) for n in (1, 2))
    assert (one.transmission_error == two.transmission_error).all()
    assert (one.backlash == two.backlash).all()
    assert (one.pin_force == two.pin_force).all()


def test_a_surface_goes_through_its_file_bit_for_bit(tmp_path):
    rng = np.random.default_rng(0)
    surface = dataclasses.replace(
        surface_of_pair(ERRORS),
        gear_deviation=rng.normal(0, 1e-6, (1, 39, 60, 4)),
        pin_deviation=rng.normal(0, 1e-6, (40, 50, 4)),
    )
    write_surface(surface, tmp_path / "s.nc")
    again = read_surface(tmp_path / "s.nc")
    first, second = (solve(DriveValue(ERRORS, s), -120.0, ANGLES, 4).transmission_error for s in (surface, again))
    assert (first == second).all()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda d: d.isel(tooth=slice(0, 38)), "38"),
        (lambda d: d.where(d["profile"] > 3), "not finite"),
        (lambda d: d * 1e3, "half a millimetre"),
        (lambda d: d.astype(str), "gear_deviation must hold numbers"),
        (lambda d: d.transpose("tooth", "disc", "profile", "width"), "dimensions"),
    ],
)
def test_a_wrong_surface_file_is_one_sentence(tmp_path, change, said):
    write_surface(flanks(surface_of_pair(ERRORS), 10, 2, 1e-6), tmp_path / "s.nc")
    with xr.open_dataset(tmp_path / "s.nc") as opened:
        data = opened.load()
    attributes = data["gear_deviation"].attrs
    data = data.assign_coords(profile=np.arange(10))
    changed = change(data["gear_deviation"])
    changed.attrs = attributes
    data = data.drop_vars("gear_deviation").drop_dims("tooth", errors="ignore") if "38" in said else data
    if "38" in said:
        data["tooth_cumulative_pitch"] = (("disc", "tooth_"), np.zeros((1, 39)), {"units": "m"})
    data["gear_deviation"] = changed
    data.to_netcdf(tmp_path / "bad.nc", engine="h5netcdf")
    with pytest.raises(edge.InputError, match=said) as refused:
        read_surface(tmp_path / "bad.nc")
    assert "bad.nc" in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("name", ["format", "pair", "units"])
def test_a_surface_file_s_texts_are_texts(tmp_path, name):
    write_surface(flanks(surface_of_pair(ERRORS), 10, 2, 1e-6), tmp_path / "s.nc")
    with xr.open_dataset(tmp_path / "s.nc") as opened:
        data = opened.load()
    (data["gear_deviation"] if name == "units" else data).attrs[name] = np.arange(3)
    data.to_netcdf(tmp_path / "bad.nc", engine="h5netcdf")
    with pytest.raises(edge.InputError, match=r"bad\.nc: .*is \[0 1 2\]; it must be text\.$"):
        read_surface(tmp_path / "bad.nc")


def test_a_truncated_surface_file_is_one_sentence(tmp_path):
    write_surface(flanks(surface_of_pair(ERRORS), 50, 5, 1e-6), tmp_path / "s.nc")
    whole = (tmp_path / "s.nc").read_bytes()
    for share in (0.0, 0.1, 0.5, 0.9):
        (tmp_path / "cut.nc").write_bytes(whole[: int(share * len(whole))])
        with pytest.raises(edge.InputError, match=r"cut\.nc"):
            read_surface(tmp_path / "cut.nc")


@pytest.mark.slow(9)
def test_the_fmu_has_the_elements(tmp_path):
    rng = np.random.default_rng(1)
    surface = dataclasses.replace(surface_of_pair(ERRORS), gear_deviation=rng.normal(0, 1e-6, (1, 39, 80, 2)))
    build_fmu(DriveValue(ERRORS, surface), tmp_path / "d.fmu")
    wanted = solve(DriveValue(ERRORS, surface), 100.0, ANGLES, 2).transmission_error[0]
    found = simulate_fmu(tmp_path / "d.fmu", ANGLES, 100.0, ("transmission_error",))["transmission_error"]
    assert found == pytest.approx(wanted, abs=1e-9)


def test_an_interrupted_sweep_keeps_what_is_done():
    def stop(done):
        seen.append(done)
        if len(seen) == 2:
            raise KeyboardInterrupt

    seen = []
    angles = np.linspace(0, 6, 2000)
    with pytest.raises(Interrupted) as interrupted:
        solve(DriveValue.as_stated(ERRORS), -120.0, angles, progress=stop)
    kept = interrupted.value.result
    assert 0 < kept.crank_angle.size < 2000
    whole = solve(DriveValue.as_stated(ERRORS), -120.0, angles)
    assert (kept.transmission_error == whole.transmission_error[:, : kept.crank_angle.size]).all()


@pytest.mark.slow(6)
@pytest.mark.skipif(sys.platform != "linux", reason="reads a process' time from /proc")
def test_ctrl_c_writes_what_is_done(tmp_path):
    (tmp_path / "pair.toml").write_text(TILTED.text)
    command = str(Path(sys.executable).with_name("cycloid-fmu"))
    words = [
        command,
        "analyze",
        "pair.toml",
        "--torque",
        "50 N*m",
        "--slices",
        "60",
        "--angles",
        "20000",
        "-o",
        "out.nc",
    ]
    # Only a terminal is shown the progress.
    terminal, end = os.openpty()
    with subprocess.Popen(words, cwd=tmp_path, stderr=end, env={**os.environ, "TERM": "xterm"}) as process:
        os.close(end)
        said = b""
        while not re.search(rb"[1-9]\d*%", said):
            said += os.read(terminal, 4096)
        process.send_signal(signal.SIGINT)
        with contextlib.suppress(OSError):  # the terminal ends with the process
            while more := os.read(terminal, 4096):
                said += more
    os.close(terminal)
    assert process.returncode == 130, said
    assert b"crank angles are done" in said
    with xr.open_dataset(tmp_path / "out.nc") as data:
        assert data.attrs["complete"] == 0
        assert 0 < data.sizes["crank_angle"] < 20000
        assert np.isfinite(data["transmission_error"].values).all()
