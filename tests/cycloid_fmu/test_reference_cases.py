"""Against an independent slow solver's results, and against the figures of the papers."""

import json

import brute_force
import numpy as np
import pytest
from common import ARCSEC, CASES, PAIR, make_pair

from cycloid_fmu.analysis import analyze, solve
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.geometry.pair import parse_pair, read_pair
from cycloid_fmu.surfaces.structured import with_structured
from cycloid_fmu.surfaces.surface import nominal_surface, surface_of_pair


@pytest.mark.parametrize("case", sorted(p.stem for p in CASES.glob("*.toml")))
def test_reference_case(case, record_property):
    wanted = json.loads((CASES / f"{case}.json").read_text())
    pair = read_pair(CASES / f"{case}.toml")
    torques = [r["torque"] for r in wanted["results"]]
    found = solve(DriveValue.as_stated(pair), torques, wanted["crank_angle"], wanted["slices"])
    away = {"transmission error": 0.0, "backlash": 0.0, "largest pressure": 0.0}
    for load, result in enumerate(wanted["results"]):
        backlash = np.array([np.nan if b is None else b for b in result["backlash"]])
        for name, difference in (
            ("transmission error", (found.transmission_error[load] - result["transmission_error"]) / ARCSEC),
            ("backlash", np.nan_to_num(found.backlash - backlash) / ARCSEC),
            ("largest pressure", 100.0 * (found.max_contact_pressure[load] / result["max_contact_pressure"] - 1.0)),
        ):
            away[name] = max(away[name], np.abs(difference).max())
        assert found.transmission_error[load] == pytest.approx(result["transmission_error"], abs=0.01 * ARCSEC)
        assert found.backlash == pytest.approx(backlash, abs=0.01 * ARCSEC, nan_ok=True)
        assert found.interference == pytest.approx(result["interference"], abs=2e-10)
        assert found.max_contact_pressure[load] == pytest.approx(result["max_contact_pressure"], rel=5e-3)
        assert found.contact_count[load].tolist() == result["contact_count"]
        largest = np.max(result["pin_force"])
        assert found.pin_force[load].sum(axis=1) == pytest.approx(np.array(result["pin_force"]), abs=1e-3 * largest)
    for name, largest in away.items():
        unit = "%" if name == "largest pressure" else "″"
        record_property(f"largest difference of {name} from the independent solver", f"{largest:.2g} {unit}")


@pytest.mark.parametrize("seed", [0, 1, 2, *(pytest.param(one, marks=pytest.mark.slow(1)) for one in (3, 4, 5))])
def test_brute_force_of_a_random_pair(seed, tmp_path):
    """Any pair between 6 and 120 teeth, against the plain NumPy scan of the flank."""
    rng = np.random.default_rng(seed)
    teeth = int((6, 9, 17, 50, 83, 120)[seed])
    um = [[f"{v:.3f} um" for v in rng.normal(0.0, 2.0, n)] for n in (teeth + 1, teeth + 1, teeth)]
    text = f"""format = "cycloid-pair/1"
[pair]
gear_teeth = {teeth}
pins = {teeth + 1}
pin_circle_radius = "60 mm"
pin_radius = "{rng.uniform(0.3, 0.5) * 60 / (teeth + 1):.4f} mm"
eccentricity = "{rng.uniform(0.5, 0.85) * 60 / (teeth + 1):.4f} mm"
face_width = "8 mm"
[modification]
offset = "{-rng.uniform(20, 60):.2f} um"
isometric = "{rng.uniform(-20, 10):.2f} um"
[errors]
pin_radial = {um[0]}
pin_tangential = {um[1]}
tooth_cumulative_pitch = {um[2]}
centre_distance_x = "{rng.normal(0, 3):.2f} um"
eccentricity = "{rng.normal(0, 1):.2f} um"
"""
    (tmp_path / "pair.toml").write_text(text)
    pair, plain = parse_pair(text, "random.toml"), brute_force.load_pair(tmp_path / "pair.toml")
    angle, torque = rng.uniform(0.0, 100.0), rng.choice([-1.0, 1.0]) * rng.uniform(20.0, 200.0)
    wanted = brute_force.solve(plain, angle, torque, points=40)
    found = solve(DriveValue.as_stated(pair), torque, angle)
    assert found.transmission_error[0, 0] == pytest.approx(wanted["transmission_error"], abs=0.01 * ARCSEC)
    assert found.backlash[0] == pytest.approx(wanted["backlash"], abs=0.01 * ARCSEC, nan_ok=True)
    assert found.max_contact_pressure[0, 0] == pytest.approx(wanted["max_contact_pressure"], rel=5e-3)
    assert found.contact_count[0, 0] == wanted["contact_count"]


def test_error_surface_pair_of_the_paper():
    """Capped and as printed, and the paper's own figures beside them."""
    angles = np.linspace(0.0, 2 * np.pi, 3600, endpoint=False)
    capped = solve(DriveValue(make_pair(), nominal_surface(make_pair())), -181.0, angles)
    te = capped.transmission_error[0] / ARCSEC
    assert te.mean() == pytest.approx(-4.5015, abs=1e-4)
    assert te.mean() == pytest.approx(-4.5206, rel=5e-3)  # the paper
    assert np.ptp(te) == pytest.approx(0.0364, abs=2e-4)
    assert capped.max_contact_pressure.max() == pytest.approx(1061.1e6, rel=1e-4)
    assert set(capped.contact_count[0]) == {19, 20}
    assert np.abs(capped.backlash).max() < 1e-9

    printed_pair = make_pair(contact_law="as_printed")
    printed = solve(DriveValue(printed_pair, nominal_surface(printed_pair)), -181.0, angles, with_play=False)
    te = printed.transmission_error[0] / ARCSEC
    assert te.mean() == pytest.approx(-4.504, abs=1e-3)
    assert 0.08 <= np.ptp(te) <= 0.14
    assert 1066e6 < printed.max_contact_pressure.max() < 1076e6
    assert printed.max_contact_pressure.max() == pytest.approx(1067.5e6, rel=8e-3)  # the paper


def test_wear_pair_unloaded():
    """Mean -3.360″ at one flank, 0.606″ peak to peak, backlash 6.720″ and 0.733″.

    Its peaks are those of some 16 angles a pin pitch; converged they are 0.611″ and 0.740″.
    """
    text = PAIR.replace("64 mm", "66 mm") + '[modification]\noffset = "-50 um"\nisometric = "-30 um"\n'
    pair = parse_pair(text, "wear.toml")
    angles = np.linspace(0.0, 2 * np.pi, 3600, endpoint=False)
    found = solve(DriveValue(pair, nominal_surface(pair)), 0.0, angles)
    assert found.play_low.mean() / ARCSEC == pytest.approx(-3.360, abs=1e-3)
    assert np.ptp(found.play_low) / ARCSEC == pytest.approx(0.606, abs=6e-3)
    assert found.backlash.mean() / ARCSEC == pytest.approx(6.720, abs=1e-3)
    assert np.ptp(found.backlash) / ARCSEC == pytest.approx(0.733, abs=8e-3)
    assert found.transmission_error[0] == pytest.approx(0.5 * (found.play_low + found.play_high), abs=1e-12)


@pytest.mark.parametrize(
    ("torque", "te", "pressure", "counts"),
    [(-200.0, -18.175, 1547, {5, 6}), (-400.0, -26.206, 2022, {6, 7}), (-800.0, -38.654, 2687, {7, 8})],
)
def test_wear_pair_loaded(torque, te, pressure, counts):
    text = PAIR.replace("64 mm", "66 mm") + '[modification]\noffset = "-50 um"\nisometric = "-30 um"\n'
    pair = parse_pair(text, "wear.toml")
    found = solve(DriveValue(pair, nominal_surface(pair)), torque, np.linspace(0.0, 2 * np.pi, 3600, endpoint=False))
    assert found.transmission_error.mean() / ARCSEC == pytest.approx(te, abs=2e-3)
    assert found.max_contact_pressure.max() == pytest.approx(pressure * 1e6, rel=1e-3)
    assert set(found.contact_count[0]) == counts


@pytest.mark.parametrize(
    ("name", "order", "amplitude"),
    [
        ("pin_radial_1_cos", 39, 24.3),
        ("pin_tangential_1_cos", 39, 32.5),
        ("tooth_cumulative_pitch_1_cos", 40, 31.7),
        ("centre_distance_x", 39, 40.7),
    ],
)
def test_order_and_amplitude_of_ten_micrometres(name, order, amplitude):
    """Leading orders of 10 µm each: pin errors give orders 39k of the output, tooth errors 40k."""
    pair = parse_pair(PAIR + '[modification]\noffset = "-70 um"\nisometric = "-25 um"\n', "modified.toml")
    surface = with_structured(nominal_surface(pair), {name: 1e-5})
    count = 39 * 120
    angles = np.linspace(0.0, 2 * np.pi * 39, count, endpoint=False)
    te = solve(DriveValue(pair, surface), 100.0, angles, with_play=False).transmission_error[0] / ARCSEC
    spectrum = 2 * np.abs(np.fft.rfft(te)) / count
    leading = int(np.argmax(spectrum[1:])) + 1
    assert leading == order
    assert spectrum[leading] == pytest.approx(amplitude, rel=0.1)
    others = np.delete(spectrum, np.arange(0, spectrum.size, order))
    assert others.max() < 1e-4 * amplitude


def test_error_free_only_the_mesh_ripple():
    pair = make_pair()
    angles = np.linspace(0.0, 2 * np.pi * 39, 39 * 160, endpoint=False)
    te = solve(DriveValue(pair, nominal_surface(pair)), 181.0, angles, with_play=False).transmission_error[0]
    spectrum = np.abs(np.fft.rfft(te))
    assert int(np.argmax(spectrum[1:])) + 1 == 1560


def test_ring_as_output_turns_the_other_way():
    """Held gear, turning ring: ratio +z_p, and the same flanks under the same load at the same relative position."""
    text = (CASES / "errors-39-40.toml").read_text()
    pair = parse_pair(text.replace("[pair]", '[pair]\noutput = "ring"'), "ring.toml")
    free = surface_of_pair(pair)
    still = with_structured(free, {"centre_distance_x": 0.0, "centre_distance_y": 0.0})
    gear = parse_pair(text, "gear.toml")
    same = with_structured(surface_of_pair(gear), {"centre_distance_x": 0.0, "centre_distance_y": 0.0})
    theta = 1.7
    ring = solve(DriveValue(pair, still), 100.0, theta)
    # In the ring's frame the crank is at θ - φ_b and the gear is rotated by -φ_b from it.
    output = theta / 40 + 0.5 * (ring.play_low[0] + ring.play_high[0])
    relative = solve(DriveValue(gear, same), 0.0, theta - output)
    assert relative.backlash[0] == pytest.approx(ring.backlash[0] * 40 / 39, rel=2e-3)


def test_dataset_names_units_and_shape():
    data = analyze(
        DriveValue(make_pair(discs=2), nominal_surface(make_pair(discs=2))), [-50.0, 100.0], np.linspace(0, 1, 5)
    )
    assert data.attrs["format"] == "cycloid-analysis/1"
    assert data["transmission_error"].dims == ("torque", "crank_angle")
    assert data["pin_force"].dims == ("torque", "crank_angle", "disc", "pin")
    assert dict(data.sizes) == {"torque": 2, "crank_angle": 5, "disc": 2, "pin": 40}
    assert {data[n].attrs["units"] for n in ("transmission_error", "backlash", "crank_angle")} == {"rad"}
    assert all("units" in data[n].attrs for n in data.data_vars)
