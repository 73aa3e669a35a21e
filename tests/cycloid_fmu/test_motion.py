"""The picture of a drive: positions are those of the drive, and the forces shown balance."""

import dataclasses
import json
import re
import shutil

import numpy as np
import pytest
from common import EXAMPLES
from matplotlib.figure import Figure

import cycloid_fmu as cy
from cycloid_fmu.draw.drive_page import page_data, write_motion
from cycloid_fmu.draw.drive_picture import draw_error
from cycloid_fmu.geometry.profile import equal_arc_parameters, flank_points
from cycloid_fmu.motion import PROFILE

CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")
SIZES = dict(gear_teeth=39, pin_circle_radius="64 mm", pin_radius="3 mm", eccentricity="1.3 mm", face_width="10 mm")
MODIFIED = cy.Pair(**SIZES, modification={"isometric": "-15 um", "offset": "-40 um"})
ERRORS = {
    "centre_distance_x": "4 um",
    "centre_distance_y": "-3 um",
    "eccentricity": "2 um",
    "pin_radius": "-1 um",
    "pin_radial": {2: ("2.5 um", "40 deg")},
    "pin_tangential": {3: ("1.5 um", "-70 deg")},
    "tooth_cumulative_pitch": {1: ("3 um", "120 deg")},
}
PAIRS = {
    "one disc": MODIFIED,
    "errors": MODIFIED.replace(errors=ERRORS),
    "two discs": MODIFIED.replace(discs=2, errors={"pin_radial": {1: ("5 um", "0 deg")}}),
    "ring turns": MODIFIED.replace(output="ring", errors=ERRORS),
    "few teeth": cy.Pair(
        gear_teeth=11,
        pin_circle_radius="50 mm",
        pin_radius="5 mm",
        eccentricity="2.5 mm",
        face_width="10 mm",
        modification={"isometric": "-15 um", "offset": "-60 um"},
    ),
}


def distance(points, outline):
    """Distance of each point from a closed polyline, > 0 outside."""
    start = outline[np.abs(np.roll(outline, -1) - outline) > 1e-9]  # two teeth share a root
    along = np.roll(start, -1) - start
    part = np.clip(((points[:, None] - start) * np.conj(along)).real / np.abs(along) ** 2, 0.0, 1.0)
    apart = points[:, None] - start - part * along
    nearest = np.abs(apart).argmin(axis=1)
    chosen = apart[np.arange(points.size), nearest]
    outwards = np.sign((chosen * np.conj(-1j * along[nearest])).real)  # the outline runs counter-clockwise
    return outwards * np.abs(chosen)


def test_the_outline_at_factor_one_is_the_flank():
    motion = cy.Drive(MODIFIED).motion(181.0, [0.3, 2.0])
    alpha = np.concatenate([[0.0], equal_arc_parameters(MODIFIED, PROFILE - 2), [2.0 * np.pi / 39]])
    every = 2.0 * np.pi * np.arange(39)[:, None] / 39 + alpha
    x, y = flank_points(MODIFIED, every)
    for angle, theta in enumerate((0.3, 2.0)):
        turn = -theta / 39 + motion.transmission_error[0, angle]
        want = 1.3e-3 * np.exp(1j * theta) + np.exp(1j * turn) * (x + 1j * y)
        assert np.abs(motion.outline(0, angle, 0, 1.0) - want.ravel()).max() < 1e-12


@pytest.mark.parametrize("name", PAIRS)
def test_contacts_are_on_pin_and_flank_and_balance_the_torque(name):
    """Touching points are a gap off their pin, and on the flank; forces along the line to the pin's axis carry all."""
    pair = PAIRS[name]
    torques = [181.0, -40.0]
    motion = cy.Drive(pair).motion(torques, np.linspace(0.0, 6.0, 7))
    near = np.isfinite(motion.gap)
    assert near.any(axis=4).all()
    pins = motion.pin_axis[:, :, None, :, None]
    off = np.abs(motion.touching - pins) - motion.pin_radius[:, None]
    assert np.abs(off - motion.gap)[near].max() < 1e-12
    for load, angle, disc in np.ndindex(motion.gap.shape[:3]):
        at = near[load, angle, disc]
        points = motion.touching[load, angle, disc][at]
        chord = 5e-6  # between the outline's points the flank deviates by less
        assert np.abs(distance(points, motion.outline(load, angle, disc, 1.0))).max() < chord
    # The pins' forces turn the disc against the torque about its own centre; on a ring the disc's do, about the middle.
    about, sense = (0.0, -1.0) if pair.output == "ring" else (motion.centre[..., None, None], 1.0)
    moment = (np.conj(motion.touching - about) * sense * motion.force * motion.direction).imag
    assert moment.sum(axis=(2, 3, 4)) == pytest.approx(-np.array(torques)[:, None] * np.ones(7), rel=1e-6)


def test_contacts_are_on_the_equation_of_the_flank():
    motion = cy.Drive(MODIFIED).motion(181.0, [0.3, 2.0])
    near = np.isfinite(motion.gap)
    own = (motion.touching - motion.centre[..., None, None]) * np.exp(-1j * motion.rotation[..., None, None])
    points = own[near]
    alpha, step = np.angle(points)[:, None], 2.0 * np.pi / 39 / 2.0
    for _ in range(5):
        tried = alpha + step * np.linspace(-1.0, 1.0, 401)
        x, y = flank_points(MODIFIED, tried)
        best = np.abs(x + 1j * y - points[:, None]).argmin(axis=1)
        alpha, step = tried[np.arange(points.size), best][:, None], step / 100.0
    x, y = flank_points(MODIFIED, alpha[:, 0])
    assert np.abs(x + 1j * y - points).max() < 1e-9


@pytest.mark.parametrize("name", PAIRS)
def test_exaggerated_gaps_are_so_many_times_the_gaps(name):
    """Where no one chooses the factor every pin's gap has room; flanks that touch still do, at the same place."""
    motion = cy.Drive(PAIRS[name]).motion(181.0, [0.4, 3.3])
    factor = motion.exaggeration
    for angle, disc in np.ndindex(2, motion.pair.discs):
        drawn = distance(motion.pin_axis[0, angle], motion.outline(0, angle, disc)) - motion.pin_radius
        gap = motion.gap[0, angle, disc].min(axis=1)
        chord = factor * 5e-6  # between the outline's points
        assert drawn == pytest.approx(factor * gap, rel=0.05, abs=chord)
        assert gap.max() > 1e-5


def test_forces_and_errors_are_those_of_the_sweep():
    drive = cy.Drive(PAIRS["two discs"])
    theta = np.array([0.1, 1.1])
    data, motion = drive.analyze([150.0], crank_angle=theta), drive.motion(150.0, theta)
    assert motion.force.sum(axis=4) == pytest.approx(data.pin_force.values, abs=1e-3)
    assert motion.pressure == pytest.approx(data.pin_pressure.values, rel=1e-9)
    assert motion.curve[0, :3] == pytest.approx(
        drive.analyze([150.0], crank_angle=motion.curve_angle[:3]).transmission_error.values[0], abs=1e-12
    )


@pytest.mark.parametrize("name", PAIRS)
def test_stated_transmission_error_is_that_of_the_analysis(name):
    """Mean and peak to peak of the picture and of the page, as the analysis states them."""
    drive = cy.Drive(PAIRS[name])
    error = drive.analyze([150.0]).transmission_error.values[0] * cy.ARCSEC
    motion = drive.motion(150.0, 0.0)
    data = page_data(motion)
    assert (data["mean"][0], data["peak_to_peak"][0]) == pytest.approx((error.mean(), np.ptp(error)), abs=6e-5)
    axis = Figure().subplots()
    draw_error(axis, motion)
    assert axis.get_title() == f"transmission error: mean {error.mean():.2f}″, peak to peak {np.ptp(error):.2f}″"


def test_without_load_nothing_presses():
    motion = cy.Drive(PAIRS["errors"]).motion(0.0, np.linspace(0.0, 6.0, 5))
    assert not motion.force.any()
    assert motion.gap.min() > 0.0


def test_a_drive_that_interferes_presses_without_load():
    """An offset above zero adds material: no free position, and pins press on both flanks without a torque."""
    motion = cy.Drive(cy.Pair(**SIZES, modification={"offset": "10 um"})).motion(0.0, [0.4])
    force, lever = motion.force[0, 0, 0], motion.touching[0, 0, 0] - motion.centre[0, 0, 0]
    moment = (np.conj(lever) * force * motion.direction[0, 0, 0]).imag
    assert force.max() > 10.0
    assert abs(moment.sum()) < 1e-6 * np.abs(moment).sum()


def test_interference_is_exaggerated_within_the_picture_too():
    """Of a pair whose pins all press, the outline stays as near to the pins as gaps have room."""
    motion = cy.Drive(cy.Pair(**SIZES, modification={"isometric": "-60 um"})).motion(181.0, [0.4])
    assert motion.nearest.max() < 0.0
    moved = motion.outline(0, 0, 0) - motion.outline(0, 0, 0, 1.0)
    assert 0.1 * motion.room < np.abs(moved).max() < 1.05 * motion.room


def test_rigid_supports_change_nothing():
    bare = PAIRS["two discs"]
    held = bare.replace(supports={"kind": "cranks", "count": 3, "circle_radius": "36 mm"})
    one, other = (cy.Drive(pair).motion(181.0, [0.2, 4.0]) for pair in (bare, held))
    assert np.abs(one.centre - other.centre).max() < 1e-9
    assert np.abs(one.outline(0, 1, 1) - other.outline(0, 1, 1)).max() < 1e-6
    assert one.force.sum(axis=4) == pytest.approx(other.force.sum(axis=4), abs=0.5)


@pytest.mark.slow(2)
def test_form_and_wear_raise_the_close_up():
    drive = cy.Drive(MODIFIED)
    worn = np.zeros((1, 39, 50, 1))
    worn[0, 7, 20:30] = -9e-6
    surface = drive.surface.replace(gear_deviation=worn)
    motion = cy.Drive(MODIFIED, surface).motion(181.0, 0.3)
    plain = drive.motion(181.0, 0.3)
    change = motion.raised - plain.raised
    assert change.min() == pytest.approx(-9e-6, rel=1e-6)
    assert np.flatnonzero(np.abs(change).max(axis=(0, 2)) > 1e-12).tolist() == [7]


def test_a_picture_that_is_all_to_scale_or_too_large_is_chosen_or_refused():
    drive = cy.Drive(MODIFIED)
    assert drive.motion(181.0, exaggeration=1.0).exaggeration == 1.0
    with pytest.raises(cy.InputError, match="exaggeration"):
        drive.motion(181.0, exaggeration=0.0)
    with pytest.raises(cy.InputError, match="crank_angle"):
        drive.motion(181.0, "30")


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--torque", "1 N*m", "--torque", "2 N*m", "-o", "x.svg"], "--torque = "),
        (["--exaggeration", "nan", "-o", "x.svg"], "--exaggeration = nan"),
        (["-o", "x.gif"], "--output = x.gif"),
    ],
)
def test_bad_input_is_a_sentence(command, words, sentence):
    done = command("cycloid-fmu", "draw", EXAMPLES / "drive-39-40.toml", *words)
    assert done.returncode == 2
    assert done.stderr.startswith(sentence)
    assert done.stderr.count("\n") == 1


@pytest.mark.slow(3)
def test_the_command_draws_the_same_file_twice(command, tmp_path):
    for name in ("one.svg", "two.svg"):
        done = command("cycloid-fmu", "draw", EXAMPLES / "drive-39-40-as-made.toml", "--torque", "181 N*m", "-o", name)
        assert done.returncode == 0, done.stderr
        assert "gaps × " in done.stdout
    assert (tmp_path / "one.svg").read_bytes() == (tmp_path / "two.svg").read_bytes()


@pytest.mark.slow(5)
def test_an_animated_page_samples_each_pin_pitch_alike(command, tmp_path):
    # Without errors the transmission error has the period of a pin pitch, and so has its curve.
    done = command("cycloid-fmu", "draw", EXAMPLES / "drive-39-40.toml", "--torque", "181 N*m", "-o", "drive.html")
    assert done.returncode == 0, done.stderr
    curves = re.search(r'"error":(\[\[.*?\]\])', (tmp_path / "drive.html").read_text(encoding="utf-8"))[1]
    at_rated_torque = np.array(json.loads(curves))[-1].reshape(40, -1)
    assert np.ptp(at_rated_torque, axis=0).max() < 1e-3 < np.ptp(at_rated_torque)


@pytest.fixture(scope="module")
def shown(tmp_path_factory):
    playwright = pytest.importorskip("playwright.sync_api")
    if CHROMIUM is None:
        pytest.skip("no chromium on this machine")
    path = tmp_path_factory.mktemp("drive") / "a drive.html"
    motion = cy.Drive(PAIRS["two discs"]).motion([-181.0, 0.0, 181.0], np.linspace(0.0, 6.0, 10))
    write_motion(motion, path, 2, 3)
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": 420, "height": 900})
        page.said, page.asked = [], []
        page.on("console", lambda m: page.said.append(m.text))
        page.on("pageerror", lambda e: page.said.append(str(e)))
        page.on("request", lambda r: page.asked.append(r.url))
        page.goto(path.as_uri())
        yield page, motion
        browser.close()


def on_page(page, disc):
    numbers = re.findall(r"-?\d+\.\d+", page.locator(f"#disc-{disc}").get_attribute("d"))
    x, y = np.array(numbers, float).reshape(-1, 2).T
    return x + 1j * y


@pytest.mark.system
def test_the_page_shows_what_the_library_computes_and_asks_for_nothing(shown):
    page, motion = shown
    assert page.said == []
    assert len(page.asked) == 1
    for load, angle in ((2, 3), (0, 7)):
        page.locator("#load").fill(str(load))
        page.locator("#angle").fill(str(angle))
        for disc in range(2):
            assert np.abs(on_page(page, disc) - motion.outline(load, angle, disc) * 1e3).max() < 2e-3  # mm
        axes, radii = motion.pin_axis[load, angle], motion.pin_radius
        for pin in (0, 17):
            x, y, r = (float(page.locator(f"#pin-{pin}").get_attribute(name)) for name in ("cx", "cy", "r"))
            assert x + 1j * y == pytest.approx(axes[pin] * 1e3, abs=1e-3)
            assert r == pytest.approx(radii[pin] * 1e3, abs=1e-3)
        force = motion.force[load, angle]
        assert page.locator("#arrows path").count() == np.count_nonzero(force >= 0.01 * force.max())
    page.locator("#load").fill("1")
    assert page.locator("#arrows path").count() == 0
    assert page.locator("#load-value").inner_text() == "0 N·m"


@pytest.mark.system
def test_the_page_plays_and_has_room_on_a_telephone(shown):
    page, motion = shown
    assert page.evaluate("document.documentElement.scrollWidth") <= 420
    page.locator("#angle").fill("0")
    page.locator("#play").click()
    page.wait_for_function("document.getElementById('angle').value > 0")
    page.locator("#play").click()
    assert f"× {motion.exaggeration:g}" in page.locator("#caption").inner_text()


def test_a_name_in_the_data_can_not_end_the_script(tmp_path):
    motion = cy.Drive(MODIFIED).motion(181.0, 0.0)
    page = tmp_path / "x.html"
    write_motion(dataclasses.replace(motion), page)
    script = page.read_text(encoding="utf-8").split("<script>")[1]
    assert script.count("</script>") == 1
    json.loads(re.search(r"const d = (\{.*\});\n", script)[1])
