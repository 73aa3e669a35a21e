"""Surfaces measured: points of a known drive give its errors back."""

import dataclasses

import numpy as np
import pytest
from cmm import measure, write_csv
from common import PAIR, make_pair

from cycloid_fmu import edge
from cycloid_fmu.geometry.profile import arc_parts, equal_arc_parameters, flank_normals, flank_points, flank_speed
from cycloid_fmu.surfaces.files import read_surface, write_surface
from cycloid_fmu.surfaces.measuring import closest_on_tooth, fitted_circle, measured_surface, read_points
from cycloid_fmu.surfaces.sampling import parse_tolerances, sample_surface
from cycloid_fmu.surfaces.surface import Elements, check_surface, nominal_surface

MODIFIED = '[modification]\noffset = "-40 um"\nisometric = "-15 um"\n'
# Twelve teeth of two discs: few points, quick fits.
SMALL = make_pair(
    PAIR + MODIFIED,
    gear_teeth=12,
    pins=13,
    pin_circle_radius="40 mm",
    eccentricity="1.5 mm",
    pin_radius="4 mm",
    discs=2,
)
BIG = make_pair(PAIR + MODIFIED)
TOLERANCES = """format = "cycloid-tolerances/1"
[gear_profile]
tolerance = "6 um"
[pin_profile]
tolerance = "6 um"
[gear_pitch]
single = "4 um"
cumulative = "9 um"
[pin_pitch]
single = "4 um"
cumulative = "9 um"
[pin_circle_diameter]
tolerance = "9 um"
distribution = "uniform"
[pin_radius]
tolerance = "5 um"
distribution = "uniform"
[pin_radius_each]
tolerance = "2 um"
"""
FRAME = (0.012 - 0.03j, 2.0)
NOISE = 5e-7


def rms(values):
    return np.sqrt(np.mean(np.square(values)))


def without(values, columns):
    """The remainder of values without their least-squares share of the columns."""
    return values - columns @ np.linalg.lstsq(columns, values, rcond=None)[0]


def known_drive(pair, seed, elements):
    """A sampled drive whose form holds no pitch, shift or radius: those have names of their own."""
    g = pair
    s = sample_surface(pair, parse_tolerances(TOLERANCES, "t.toml"), seed, elements)
    generator = np.random.default_rng(seed)
    alpha = equal_arc_parameters(pair, elements.profile)
    point, normal = ((v[0] + 1j * v[1]) for v in (flank_points(pair, alpha), flank_normals(pair, alpha)))
    turns = np.exp(2j * np.pi * np.arange(g.gear_teeth) / g.gear_teeth)
    normals = np.repeat((turns[:, None] * normal)[:, :, None], elements.width, axis=2).ravel()
    arm = np.repeat((normal * point.conj()).imag, elements.width)
    columns = np.column_stack([normals.real, normals.imag, np.kron(np.eye(g.gear_teeth), arm[:, None])])
    flanks = np.array([without(disc.ravel(), columns) for disc in s.gear_deviation])
    facing = np.repeat((np.arange(elements.angle) + 0.5) / elements.angle * np.pi, elements.width)
    round_ = np.column_stack([np.ones_like(facing), np.cos(facing), np.sin(facing)])
    pins = without(s.pin_deviation.reshape(g.pins, -1).T, round_).T
    at = np.exp(2j * np.pi * np.arange(g.pins) / g.pins)
    # Shifts of all pins and their common turn are the frame's.
    frame = np.vstack(
        [np.column_stack([at.real, at.imag, 0 * at.real]), np.column_stack([-at.imag, at.real, 0 * at.real + 1])]
    )
    places = without(np.concatenate([generator.uniform(-3e-6, 3e-6, g.pins), s.pin_tangential]), frame)
    return dataclasses.replace(
        s,
        gear_deviation=flanks.reshape(s.gear_deviation.shape),
        pin_deviation=pins.reshape(s.pin_deviation.shape),
        pin_radial=places[: g.pins],
        pin_tangential=places[g.pins :],
    )


def points_of(tmp_path, rows, **unit):
    return read_points(write_csv(tmp_path / "cmm.csv", rows, **unit))


def test_closest_point_is_that_of_a_search():
    """Against the smallest distance to a finely drawn tooth."""
    generator = np.random.default_rng(0)
    for pair in (SMALL, BIG):
        span = 2 * np.pi / pair.gear_teeth
        alpha = generator.uniform(0.02, 0.98, 200) * span
        point, normal = ((v[0] + 1j * v[1]) for v in (flank_points(pair, alpha), flank_normals(pair, alpha)))
        away = generator.uniform(-3e-4, 3e-4, 200)
        found, deviation, _ = closest_on_tooth(pair, point + away * normal)
        assert found == pytest.approx(alpha, abs=1e-8)
        assert deviation == pytest.approx(away, abs=1e-14)
        fine = np.linspace(-0.1, 1.1, 20001) * span
        drawn = np.add(*np.multiply(flank_points(pair, fine), [[1.0], [1.0j]]))
        scattered = point + away * normal + generator.uniform(-2e-4, 2e-4, 200)
        searched = np.abs(scattered[:, None] - drawn[None, :]).min(axis=1)
        closer = searched - np.abs(closest_on_tooth(pair, scattered)[1])
        assert closer.min() > -1e-12
        assert closer.max() < 1e-6  # half a step of the drawn tooth


def test_flank_speed_is_the_derivative_of_the_arc():
    alpha = np.linspace(0.01, 2.0, 300)
    before, after = (np.array(flank_points(BIG, alpha + h)) for h in (-1e-6, 1e-6))
    assert flank_speed(BIG, alpha) == pytest.approx(np.hypot(*(after - before)) / 2e-6, rel=1e-7)
    assert arc_parts(BIG, equal_arc_parameters(BIG, 10)) == pytest.approx((np.arange(10) + 0.5) / 10, abs=1e-6)


def test_circle_through_half_a_pin():
    angle = np.linspace(0.3, 3.3, 40)
    centre, radius = fitted_circle(0.064 + 0.01j + 3.0012e-3 * np.exp(1j * angle), robust=True)
    assert centre == pytest.approx(0.064 + 0.01j, abs=1e-12)
    assert radius == pytest.approx(3.0012e-3, abs=1e-12)


@pytest.mark.parametrize(
    ("pair", "elements", "along", "frame"),
    [
        (SMALL, Elements(16, 3, 16), 64, FRAME),
        pytest.param(BIG, Elements(12, 3, 12), 48, FRAME, marks=pytest.mark.slow(3)),
    ],
)
def test_measured_points_give_the_drive_back_within_their_noise(tmp_path, pair, elements, along, frame):
    """Every deviation within the noise of one point, 0.5 µm rms; each figure's factor of it is stated."""
    known = known_drive(pair, 4, elements)
    rows = measure(pair, known, NOISE, 1, frame, along=along, across=2 * elements.width, reach=90.0)
    surface, report = measured_surface(pair, points_of(tmp_path, rows), elements)
    assert surface.origin == "measured"
    assert report.outliers == ()
    for a in report.alignments:
        assert a.x + 1j * a.y == pytest.approx(frame[0], abs=2 * NOISE)
        assert a.rotation == pytest.approx(frame[1], abs=2 * NOISE / 0.04)
        assert 0.8 * NOISE < a.scatter < 1.3 * NOISE
    # Eight points an element: a mean's noise is 0.35 of a point's, and a little form within an element.
    for name in ("gear_deviation", "pin_deviation"):
        found, wanted = getattr(surface, name), getattr(known, name)
        assert rms(wanted) > 0.8 * NOISE
        assert rms(found - wanted) < 0.6 * NOISE
        assert np.abs(found - wanted).max() < 3.0 * NOISE
    assert np.abs(surface.tooth_cumulative_pitch - known.tooth_cumulative_pitch).max() < 0.5 * NOISE
    assert surface.pin_circle_radius == pytest.approx(
        known.pin_circle_radius + known.pin_radial.mean(), abs=0.3 * NOISE
    )
    assert surface.pin_radius == pytest.approx(known.pin_radius + known.pin_radius_deviation.mean(), abs=0.3 * NOISE)
    for name in ("pin_radial", "pin_tangential", "pin_radius_deviation"):
        wanted = getattr(known, name) - (getattr(known, name).mean() if name != "pin_tangential" else 0.0)
        assert rms(getattr(surface, name) - wanted) < 0.5 * NOISE


@pytest.mark.slow(2)
def test_without_noise_pitch_and_places_are_exact(tmp_path):
    known = dataclasses.replace(known_drive(SMALL, 2, Elements(16, 3, 16)), gear_deviation=None, pin_deviation=None)
    surface, report = measured_surface(SMALL, points_of(tmp_path, measure(SMALL, known, 0.0, 0, FRAME)))
    assert report.outliers == ()
    for name in ("tooth_cumulative_pitch", "pin_tangential"):
        assert getattr(surface, name) == pytest.approx(getattr(known, name), abs=2e-10)
    assert np.abs(surface.gear_deviation).max() < 1e-9
    assert np.abs(surface.pin_deviation).max() < 1e-9


def test_points_on_one_side_of_each_tooth_find_their_teeth(tmp_path):
    """Probed on the working flanks only: the middles of the points lie a quarter of a tooth off those of the teeth."""
    rows = measure(SMALL, nominal_surface(SMALL), NOISE, 3, FRAME, along=40, across=3)
    half = [r for i, r in enumerate(r for r in rows if r[0] == "gear") if i % 40 < 18]
    surface, report = measured_surface(SMALL, points_of(tmp_path, half), Elements(20, 3, 10))
    assert report.alignments[0].rotation == pytest.approx(2.0, abs=3e-4)
    assert rms(surface.gear_deviation) < NOISE
    assert any("no points of pins" in n for n in report.notes)
    assert not any("column z" in n for n in report.notes)
    # 18 of 40 rows: elements 0 to 8 of 20 hold points.
    assert report.gear_empty[0, 0].sum() == 11 * 3
    assert any(
        "792 of 1440 elements of the flanks have no point" in n and "tooth 0, profile 9" in n for n in report.notes
    )


def test_a_narrow_trace_is_noted(tmp_path):
    """One trace is a measurement; z in m under a header of mm looks like one."""
    rows = [(*r[:5], r[5] * 1e-3) for r in ROWS]
    _, report = measured_surface(SMALL, points_of(tmp_path, rows), Elements(5, 1, 5))
    assert sum("spans" in n and "the column z" in n for n in report.notes) == 2


@pytest.mark.slow(4)
def test_outliers_are_found_listed_and_left_out(tmp_path):
    elements = Elements(16, 3, 16)
    known = known_drive(SMALL, 4, elements)
    rows = measure(SMALL, known, NOISE, 1, FRAME, along=64, across=6, reach=90.0)
    generator = np.random.default_rng(9)
    hit = np.sort(generator.choice(len(rows), 60, replace=False))
    for i in hit:
        body, disc, number, x, y, z = rows[i]
        rows[i] = (body, disc, number, x + generator.choice([-1, 1]) * 3e-4, y + generator.choice([-1, 1]) * 3e-4, z)
    surface, report = measured_surface(SMALL, points_of(tmp_path, rows), elements)
    lines = sorted(o.line for o in report.outliers)
    # A shove along the flank leaves a point on it: of those at random a few are none.
    assert len(set(lines) & set(hit + 2)) > 55
    assert len(set(lines) - set(hit + 2)) <= 2
    assert sum(a.outliers for a in report.alignments) == len(lines)
    assert surface.attributes["outlier_lines"].split() == [str(o.line) for o in report.outliers]
    assert np.abs(surface.tooth_cumulative_pitch - known.tooth_cumulative_pitch).max() < 0.5 * NOISE
    assert rms(surface.gear_deviation - known.gear_deviation) < 0.6 * NOISE


def test_measured_surface_comes_back_from_its_file(tmp_path):
    rows = measure(SMALL, known_drive(SMALL, 1, Elements(10, 2, 10)), NOISE, 1, along=20, across=2)
    surface, _ = measured_surface(SMALL, points_of(tmp_path, rows, unit="um", scale=1e6), Elements(10, 2, 10))
    write_surface(surface, tmp_path / "s.nc")
    read = read_surface(tmp_path / "s.nc")
    check_surface(SMALL, read, "p", "s")
    for name in ("gear_deviation", "pin_deviation", "tooth_cumulative_pitch", "pin_radial"):
        assert np.array_equal(getattr(read, name), getattr(surface, name))
    assert (read.origin, read.attributes["points"]) == ("measured", "cmm.csv")


ROWS = measure(SMALL, nominal_surface(SMALL), 0.0, 0, along=12, across=2)


def few(body, number, left):
    """Rows with only the first points of a tooth of disc 0 or a pin."""
    kept, seen = [], 0
    for r in ROWS:
        if r[0] == body and r[1] in (0, "") and r[2] == number:
            seen += 1
            if seen > left:
                continue
        kept.append(r)
    return kept


@pytest.mark.parametrize(
    ("rows", "unit", "said"),
    [
        (ROWS, {"unit": "mm", "scale": 1.0}, ("x of the gear", "factor of 1000", "column x")),
        (ROWS, {"unit": "mm", "scale": 1e6}, ("x of the gear", "factor of 1000", "column x")),
        (ROWS, {"unit": "inch", "scale": 1e3}, ("x of the gear", "check the unit")),
        ([(*r[:4], r[4] * 1e3, r[5]) for r in ROWS], {}, ("y of the gear", "factor of 1000", "column y")),
        ([(*r[:5], r[5] * 1e3) for r in ROWS], {}, ("line 2", "z is", "column z")),
        ([r if r[0] == "gear" else (*r[:3], r[3] * 1e3, *r[4:]) for r in ROWS], {}, ("x of the pins", "of 1000")),
        (few("gear", 5, 7), {}, ("tooth 5 of disc 0 has 7 points", "at least 8")),
        (few("gear", 5, 0), {}, ("tooth 5 of disc 0 has 0 points",)),
        (few("pin", 3, 2), {}, ("pin 3 has 2 points", "at least 6")),
        ([r for r in ROWS if r[1] != 1], {}, ("tooth 0 of disc 1 has 0 points",)),
        ([*ROWS, ("gear", 2, 0, 0.04, 0.0, 0.0)], {}, (f"line {len(ROWS) + 2}: disc 2", "the pair has 2")),
        ([*ROWS, ("gear", 0, 12, 0.04, 0.0, 0.0)], {}, ("tooth 12 does not exist", "0 to 11")),
        ([(*r[:2], -r[2] % 12 if r[0] == "gear" else r[2], *r[3:]) for r in ROWS], {}, ("counter-clockwise",)),
        (
            [(*r[:2], {3: 4, 4: 3}.get(r[2], r[2]) if r[0] == "gear" else r[2], *r[3:]) for r in ROWS],
            {},
            ("of disc 0", "from its position: check its number"),
        ),
        ([(*r[:2], -r[2] % 13 if r[0] == "pin" else r[2], *r[3:]) for r in ROWS], {}, ("counter-clockwise",)),
    ],
)
def test_points_that_cannot_be_are_one_sentence(tmp_path, rows, unit, said):
    with pytest.raises(edge.InputError) as caught:
        measured_surface(SMALL, points_of(tmp_path, rows, **unit))
    text = str(caught.value)
    assert text.startswith(str(tmp_path / "cmm.csv"))
    assert "\n" not in text
    for part in said:
        assert part in text


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("", 'there is no column "x [m]"'),
        ("body,disc,number,x [mm],y [mm],z [mm]\n", "no points"),
        ("body,disc,number,x,y [mm],z [mm]\n", 'write "x [m]"'),
        ("body,disc,number,x [kg],y [mm],z [mm]\n", "measures something else"),
        ("body,disc,number,x [mm],y [mm]\n", 'no column "z [m]"'),
        ("body,disc,x [mm],y [mm],z [mm]\n", 'no column "number"'),
        ("body,disc,number,x [mm],y [mm],z [mm]\nring,0,0,1,1,1\n", 'line 2: body = "ring"'),
        ("body,disc,number,x [mm],y [mm],z [mm]\ngear,0,-1,1,1,1\n", 'line 2: number = "-1"'),
        ("body,disc,number,x [mm],y [mm],z [mm]\ngear,,1,1,1,1\n", 'line 2: disc = ""'),
        ("body,disc,number,x [mm],y [mm],z [mm]\ngear,0,1,nan,1,1\n", 'line 2: x = "nan"'),
        ('body,disc,number,x [mm],y [mm],z [mm]\npin,,1,"1,5",1,1\n', 'line 2: x = "1,5"'),
        ("body,disc,number,x [mm],y [mm],z [mm]\npin,,1,1,1\n", 'line 2: z = ""'),
    ],
)
def test_bad_files_are_one_sentence(tmp_path, content, said):
    (tmp_path / "cmm.csv").write_text(content)
    with pytest.raises(edge.InputError, match=r"cmm\.csv: ") as caught:
        read_points(tmp_path / "cmm.csv")
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.slow(2)
def test_measured_from_the_command_line(command, tmp_path):
    rows = list(measure(SMALL, nominal_surface(SMALL), NOISE, 0, FRAME, along=12, across=2))
    rows[40] = (*rows[40][:3], rows[40][3] + 1e-4, rows[40][4] + 1e-4, rows[40][5])
    (tmp_path / "pair.toml").write_text(SMALL.text)
    write_csv(tmp_path / "cmm.csv", rows)
    words = ("cycloid-fmu", "surface", "measured", "pair.toml", "--points", "cmm.csv")
    sizes = ("--profile", 6, "--width", 2, "--angle", 6)
    run = command(*words, "-o", "s.nc", "--plot", "s.png", *sizes)
    assert run.returncode == 0, run.stderr
    assert "gear, disc 1" in run.stdout
    assert "cmm.csv: line 42: gear, disc 0, tooth 1 is" in run.stdout
    assert read_surface(tmp_path / "s.nc").gear_deviation.shape == (2, 12, 6, 2)
    assert (tmp_path / "s.png").stat().st_size > 20000
    write_csv(tmp_path / "cmm.csv", rows, scale=1.0)
    run = command(*words, "-o", "bad.nc")
    assert (run.returncode, run.stdout) == (2, "")
    assert "factor of 1000" in run.stderr
    assert run.stderr.count("\n") == 1
    assert sorted(p.name for p in tmp_path.iterdir()) == ["cmm.csv", "pair.toml", "s.nc", "s.png"]
