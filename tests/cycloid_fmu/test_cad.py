"""Discs in files: read back by other libraries and compared with the flank's formula."""

import math
import sys
from xml.etree import ElementTree

import ezdxf
import numpy as np
import pytest
from common import EXAMPLES, PAIR, make_pair
from ezdxf.math import bulge_to_arc
from fontTools.svgLib.path import parse_path
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree
from scipy.special import ellipe

import cycloid_fmu as cy
from cycloid_fmu import edge
from cycloid_fmu.cad.profile import profile_of
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.geometry.pair import parse_pair
from cycloid_fmu.geometry.profile import equal_arc_parameters, flank_points
from cycloid_fmu.surfaces.surface import nominal_surface

MODIFIED = parse_pair(PAIR + '[modification]\noffset = "-40 um"\nisometric = "-15 um"\n', "modified.toml")
CRANKS = EXAMPLES / "drive-39-40-bearings.toml"
ROLLERS = {
    "kind": "output_rollers",
    "count": 6,
    "circle_radius": "36 mm",
    "first_angle": "10 deg",
    "turning_arm": {"stiffness": "500 N/um", "raceway_diameter": "30 mm"},
    "output_roller": {"stiffness": "100 N/um", "radius": "4 mm", "clearance": "20 um"},
}


def formula(pair, alpha):
    """Points of the whole flank in gear frame by its formula, complex, m."""
    x, y = flank_points(pair, alpha)
    return x + 1j * y


def flank(pair, each=300):
    return formula(pair, np.linspace(0.0, 2.0 * np.pi, pair.gear_teeth * each, endpoint=False))


def nearest(points, among):
    tree = cKDTree(np.column_stack([among.real, among.imag]))
    return tree.query(np.column_stack([points.real, points.imag]))[1]


def off_formula(points, pair, turned=1.0):
    """Largest distance of points from the flank's formula, its foot found by Newton's steps with differences."""
    points = points / turned
    alpha = 2.0 * np.pi * nearest(points, flank(pair)) / flank(pair).size
    for _ in range(6):
        ahead, here, behind = (formula(pair, alpha + step) for step in (1e-6, 0.0, -1e-6))
        speed, bend = (ahead - behind) / 2e-6, (ahead - 2 * here + behind) / 1e-12
        by, rate = ((here - points) * np.conj(speed)).real, np.abs(speed) ** 2 + ((here - points) * np.conj(bend)).real
        alpha = alpha - by / rate
    return np.abs(formula(pair, alpha) - points).max()


class Arcs:
    """Arcs as another library reads their bulges: circles about their centres."""

    def __init__(self, start, bulge):
        self.start, self.end, self.bulge = np.asarray(start), np.roll(start, -1), np.asarray(bulge)
        self.flat = np.abs(self.bulge) < 1e-9
        read = [
            (*p, 0.0, 0.0, 1.0) if flat else (*(found := bulge_to_arc(p, q, b))[0], *found[1:])
            for p, q, b, flat in zip(
                *(np.column_stack([z.real, z.imag]).tolist() for z in (self.start, self.end)),
                self.bulge.tolist(),
                self.flat,
                strict=True,
            )
        ]
        x, y, first, last, self.radius = np.array(read).T
        self.centre, self.angle = x + 1j * y, (last - first) % (2.0 * np.pi)

    def points(self, each=12):
        """Points on every arc, from its start on."""
        share = np.arange(each) / each
        sweep = (np.sign(self.bulge) * self.angle)[:, None] * share
        on = self.centre[:, None] + (self.start - self.centre)[:, None] * np.exp(1j * sweep)
        return np.where(self.flat[:, None], self.start[:, None] + (self.end - self.start)[:, None] * share, on).ravel()

    def off(self, points):
        """Largest distance of points from the nearest arcs."""
        first, best = nearest(points, self.points(4)) // 4, np.full(points.size, np.inf)
        for k in ((first - 1) % self.radius.size, first, (first + 1) % self.radius.size):
            way = self.end[k] - self.start[k]
            along = ((points - self.start[k]) * np.conj(way)).real / np.abs(way) ** 2
            off = np.abs(np.abs(points - self.centre[k]) - self.radius[k])
            off = np.where(self.flat[k], np.abs(((points - self.start[k]) / way).imag * np.abs(way)), off)
            ends = np.minimum(np.abs(points - self.start[k]), np.abs(points - self.end[k]))
            best = np.minimum(best, np.where((along >= 0.0) & (along <= 1.0), off, ends))
        return best.max()


def arcs_of(profile):
    return Arcs(profile.start, profile.bulge)


def analytic_area(pair):
    """Area in the flank: that in the path of the generating pin's centre, minus its length times r, plus πr²."""
    circle, r, k = pair.generating_circle_radius, pair.generating_pin_radius, pair.shortening
    path = np.pi * (circle**2 + pair.pins * pair.eccentricity**2)
    length = 4.0 * circle * (1.0 + k) * ellipe(4.0 * k / (1.0 + k) ** 2)
    return path - r * length + np.pi * r * r, length - 2.0 * np.pi * r


@settings(max_examples=8)
@given(
    st.sampled_from([6, 11, 39, 87]),
    st.floats(0.3, 0.95),
    st.floats(0.1, 0.9),
    st.floats(-8.0, -5.0),
    st.floats(-5e-5, 5e-5),
    st.floats(-5e-5, 5e-5),
)
@example(39, 0.8125, 0.75, -7.0, -15e-6, -40e-6)
def test_arcs_stay_within_the_chord_error_of_the_formula(teeth, k, thick, limit, isometric, offset):
    limit = 10.0**limit
    try:
        pair = make_pair(
            gear_teeth=teeth,
            pins=teeth + 1,
            eccentricity=f"{k * 64 / (teeth + 1)} mm",
            pin_radius=f"{thick * 64 * math.sin(math.pi / (teeth + 1))} mm",
        ).replace(isometric=isometric, offset=offset)
    except edge.InputError:
        assume(False)
    profile = profile_of(DriveValue(pair, nominal_surface(pair)), 0, limit)
    arcs = arcs_of(profile)
    assert off_formula(arcs.points(), pair) <= limit + 1e-13
    assert arcs.off(flank(pair)) <= limit + 1e-13
    assert profile.largest_error <= limit
    area, length = analytic_area(pair)
    assert profile.area == pytest.approx(area, abs=limit * length)
    # Arcs join smoothly: the angle from each chord to the next is the rotation of both arcs to their middles.
    chord = np.roll(profile.start, -1) - profile.start
    turned = 2.0 * (np.arctan(profile.bulge) + np.arctan(np.roll(profile.bulge, -1)))
    assert np.abs(np.angle(np.roll(chord, -1) / chord * np.exp(-1j * turned))).max() < 1e-6


def test_as_many_arcs_as_the_third_root_of_the_chord_error_asks_for():
    sizes = [cy.Drive(MODIFIED).profile(chord_error=limit).bulge.size for limit in ("1 um", "0.001 um")]
    assert sizes[1] / sizes[0] == pytest.approx(10.0, rel=0.4)


@pytest.mark.parametrize("output", ["gear", "ring"])
@pytest.mark.parametrize(
    "disc", [pytest.param(0, marks=pytest.mark.slow(1)), 1, pytest.param(2, marks=pytest.mark.slow(1))]
)
def test_at_crank_angle_0_all_pins_touch_every_disc(output, disc):
    """Without modification every pin touches at every crank angle: clocked wrongly, pins would have gaps or overlap."""
    profile = cy.Drive(make_pair(discs=3, output=output)).profile(disc=disc, chord_error=1e-9)
    drawn = arcs_of(profile).points(60)
    room = np.abs(drawn[nearest(profile.pin_place, drawn)] - profile.pin_place)
    assert room == pytest.approx(profile.pin_radius, abs=2e-9)
    assert abs(profile.ring_place + 1.3e-3 * np.exp(2j * np.pi * disc / 3)) < 1e-15


@pytest.mark.slow(1)
def test_a_tooth_with_a_pitch_error_is_turned_as_a_whole():
    pitch = np.random.default_rng(3).uniform(-8e-6, 8e-6, 39)
    drive = cy.Drive(MODIFIED).replace(errors={"tooth_cumulative_pitch": pitch})
    profile = drive.profile(chord_error=5e-8)
    arcs, wide = arcs_of(profile), np.linspace(0.002, 2 * np.pi / 39 - 0.002, 4001)
    for j in (0, 7, 38):
        assert arcs.off(formula(MODIFIED, wide) * np.exp(1j * (2 * np.pi * j / 39 + pitch[j] / 64e-3))) < 5.0001e-8
    # All alike they turn the disc.
    turned = cy.Drive(MODIFIED).replace(errors={"tooth_cumulative_pitch": [4e-6] * 39}).profile()
    assert off_formula(arcs_of(turned).points(), MODIFIED, np.exp(4e-6j / 64e-3)) <= 1e-7


def test_form_of_one_height_is_an_isometric_modification():
    """Material taken off everywhere alike is a larger generating pin."""
    worn = cy.ErrorSurface(MODIFIED, gear_deviation=np.full((1, 39, 50, 4), -3e-6), origin="worn")
    profile = cy.Drive(MODIFIED, worn).profile()
    same = MODIFIED.replace(isometric=-12e-6)
    assert off_formula(arcs_of(profile).points(), same) <= 1e-7
    errors = cy.Drive(MODIFIED).replace(errors={"isometric": 3e-6}).profile()
    assert off_formula(arcs_of(errors).points(), same) <= 1e-7


@pytest.mark.slow(1)
def test_form_of_single_elements_is_where_it_was_measured():
    """The outline passes through every element's middle at its height along the normal, taken here by differences."""
    form = np.random.default_rng(1).normal(0.0, 2e-7, (1, 39, 20, 3))
    profile = cy.Drive(MODIFIED, cy.ErrorSurface(MODIFIED, gear_deviation=form)).profile(chord_error=5e-8)
    arcs, alpha = arcs_of(profile), equal_arc_parameters(MODIFIED, 20)
    ends = [np.array(flank_points(MODIFIED, alpha + step)) for step in (-1e-6, 0.0, 1e-6)]
    along = (ends[2] - ends[0]) / np.hypot(*(ends[2] - ends[0]))
    for j in (0, 20):
        x, y = ends[1] + form[0, j, :, 1] * np.array([along[1], -along[0]])
        assert arcs.off((x + 1j * y) * np.exp(2j * np.pi * j / 39)) < 5.0001e-8


def test_a_drawing_holds_at_20_degrees():
    warm = MODIFIED.replace(temperature={"ring": "60 degC", "discs": "80 degC"})
    one, other = cy.Drive(warm).profile(), cy.Drive(MODIFIED).profile()
    assert (one.start == other.start).all()
    assert (one.pin_place == other.pin_place).all()


# Files


def test_a_dxf_read_back(tmp_path):
    drive = cy.read_drive(CRANKS)
    profile = drive.profile(disc=1)
    profile.write(tmp_path / "disc.dxf")
    document = ezdxf.readfile(tmp_path / "disc.dxf")
    assert document.audit().errors == []
    assert document.header["$INSUNITS"] == 4  # mm
    assert document.header["$EXTMAX"][:2] == pytest.approx((64.0 + 1.3 + 3.0, 67.0))
    assert {"DISC", "PINS", "RING", "HOLES"} <= {layer.dxf.name for layer in document.layers}
    (outline,) = document.query('LWPOLYLINE[layer=="DISC"]')
    assert outline.closed
    x, y, bulge = np.array(outline.get_points("xyb")).T
    clocked = np.exp(-1j * np.pi / 39)  # the second disc's crank is half a turn ahead
    assert off_formula(Arcs(1e-3 * (x + 1j * y), bulge).points(), drive.pair, clocked) <= 1e-7
    pins = document.query('CIRCLE[layer=="PINS"]')
    places = 1e-3 * np.array([complex(*pin.dxf.center.vec2) for pin in pins])
    assert places == pytest.approx(64e-3 * np.exp(2j * np.pi * np.arange(40) / 40) + 1.3e-3)
    assert {pin.dxf.radius for pin in pins} == {3.0}
    (ring,) = document.query('CIRCLE[layer=="RING"]')
    assert (ring.dxf.radius, ring.dxf.center.x) == (64.0, pytest.approx(1.3))
    crosses = np.array([complex(*line.dxf.start.lerp(line.dxf.end).vec2) for line in document.query("LINE")])
    holes = drive.pair.errors["hole_x"][1] + 1j * np.array(drive.pair.errors["hole_y"][1])
    assert 1e-3 * crosses[::2] == pytest.approx(36e-3 * np.exp(2j * np.pi * np.arange(3) / 3) + holes)
    assert profile.notes == (
        "[supports.turning_arm] raceway_diameter is not stated, so the holes for the cranks have no radius: DXF and "
        "SVG mark centres, STEP has no hole.",
    )


class Pen:
    """A pen for fontTools' reader of SVG paths: it keeps the ends of arcs and lines and the arcs' bulges."""

    def __init__(self):
        self.points, self.bulges, self.closed = [], [], False

    def moveTo(self, point):  # noqa: N802
        self.points.append(complex(*point))

    def lineTo(self, point):  # noqa: N802
        if complex(*point) != self.points[0]:  # closing the path
            self.points.append(complex(*point))
            self.bulges.append(0.0)

    def arcTo(self, rx, ry, rotation, large, sweep, point):  # noqa: N802
        assert rx == ry
        assert not large
        half = math.asin(min(1.0, abs(complex(*point) - self.points[-1]) / 2 / rx))
        self.points.append(complex(*point))
        self.bulges.append(math.tan(half / 2) * (1 if sweep else -1))

    def closePath(self):  # noqa: N802
        self.closed = True


def test_an_svg_read_back(tmp_path):
    cy.Drive(MODIFIED).profile().write(tmp_path / "disc.svg")
    root = ElementTree.parse(tmp_path / "disc.svg").getroot()
    name = "{http://www.w3.org/2000/svg}"
    (up,) = root.findall(f"{name}g")
    assert up.get("transform") == "scale(1 -1)"
    side = root.get("viewBox").split()[2]
    assert (root.get("width"), root.get("height")) == (f"{side}mm", f"{side}mm")  # a unit of the drawing is 1 mm
    layers = {layer.get("id"): layer for layer in up}
    assert list(layers) == ["DISC", "PINS", "RING", "HOLES"]
    assert len(layers["PINS"]) == 40
    pen = Pen()
    parse_path(layers["DISC"][0].get("d"), pen, arc_class=None)
    assert pen.closed
    assert abs(pen.points.pop() - pen.points[0]) < 1e-12
    assert off_formula(Arcs(1e-3 * np.array(pen.points), pen.bulges).points(), MODIFIED) <= 1e-7


@pytest.mark.slow(1)
@pytest.mark.parametrize("chord_error", ["0.1 um", "2 um"])
def test_a_table_s_chords_stay_within_the_chord_error(tmp_path, chord_error):
    cy.Drive(MODIFIED).profile(chord_error=chord_error).write(tmp_path / "disc.csv")
    units = {"arc_length": "m", "angle": "rad", "x": "m", "y": "m", "curvature": "1/m"}
    rows = [row for _, row in edge.number_rows(tmp_path / "disc.csv", units)]
    read = {key: np.array([row[key] for row in rows]) for key in units}
    points, limit = read["x"] + 1j * read["y"], edge.parse_quantity(chord_error, "m")
    assert off_formula(points, MODIFIED) < 1e-15
    exact = flank(MODIFIED, 4000)
    assert 0.5 * limit < Arcs(points, np.zeros(points.size)).off(exact) <= limit
    assert np.exp(1j * read["angle"]) == pytest.approx(points / np.abs(points), abs=1e-12)
    fine = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(np.append(exact, exact[0]))))])
    assert fine[-1] == pytest.approx(analytic_area(MODIFIED)[1], rel=1e-6)
    at = np.argmin(np.abs(exact - points[200]))
    assert abs(read["arc_length"][200] - fine[at]) == pytest.approx(abs(points[200] - exact[at]), abs=1e-8)
    plain = np.genfromtxt(tmp_path / "disc.csv", delimiter=",", skip_header=1)
    normal = plain[:, 5] + 1j * plain[:, 6]
    assert np.abs(normal) == pytest.approx(1.0)
    across = (np.roll(points, -1) - np.roll(points, 1)) / np.abs(np.roll(points, -1) - np.roll(points, 1))
    assert np.median(np.abs(normal + 1j * across)) < (1e-3 if limit < 1e-6 else 5e-3)
    # Where the flank bends most a circle through three neighbours has its curvature.
    one, two, three = np.roll(points, 1), points, np.roll(points, -1)
    circle = 2.0 * ((two - one) * np.conj(three - two)).imag / np.abs((two - one) * (three - two) * (three - one))
    sharp = np.argmax(read["curvature"])
    assert read["curvature"][sharp] == pytest.approx(-circle[sharp], rel=2e-2)


@pytest.mark.slow(2)
def test_a_step_read_back(tmp_path):
    pytest.importorskip("OCP")
    from OCP.BRepCheck import BRepCheck_Analyzer
    from OCP.BRepGProp import BRepGProp
    from OCP.GProp import GProp_GProps
    from OCP.STEPControl import STEPControl_Reader
    from OCP.TopAbs import TopAbs_SOLID
    from OCP.TopExp import TopExp_Explorer

    pair = make_pair(gear_teeth=11, pins=12, eccentricity="3 mm", pin_radius="6 mm").replace(supports=ROLLERS)
    profile = cy.Drive(pair).profile(chord_error="10 um")
    profile.write(tmp_path / "disc.step")
    reader = STEPControl_Reader()
    reader.ReadFile(str(tmp_path / "disc.step"))
    reader.TransferRoots()
    explorer, volumes = TopExp_Explorer(reader.OneShape(), TopAbs_SOLID), []
    while explorer.More():
        assert BRepCheck_Analyzer(explorer.Current()).IsValid()
        properties = GProp_GProps()
        BRepGProp.VolumeProperties_s(explorer.Current(), properties, 1e-9)
        volumes.append(properties.Mass())
        explorer.Next()
    holes = np.pi * (profile.hole_radius**2).sum()
    area, length = analytic_area(pair)
    assert max(volumes) == pytest.approx(1e9 * 10e-3 * (area - holes), abs=1e9 * 10e-3 * 1e-5 * length)
    assert sorted(volumes)[:-1] == pytest.approx([np.pi * 36.0 * 10.0] * 12)


def test_holes_are_where_and_as_large_as_the_rollers_need_them():
    """A roller of the carrier is off its hole's middle by the eccentricity, and half the clearance is left."""
    pair = make_pair().replace(supports=ROLLERS)
    profile = cy.Drive(pair).profile()
    rollers = 36e-3 * np.exp(1j * (np.radians(10.0) + 2 * np.pi * np.arange(6) / 6)) + profile.ring_place
    room = profile.hole_radius[:6] - 4e-3 - np.abs(rollers - profile.hole_place[:6])
    assert room == pytest.approx(10e-6)
    assert (profile.hole_place[6], profile.hole_radius[6]) == (0.0, 15e-3)
    assert profile.notes == ()
    unknown = {**ROLLERS, "turning_arm": {"stiffness": "500 N/um"}, "output_roller": {"stiffness": "100 N/um"}}
    blank = cy.Drive(pair.replace(supports=unknown)).profile()
    assert np.isnan(blank.hole_radius).all()
    assert len(blank.notes) == 2


# The command


@pytest.mark.slow(1)
def test_the_command_writes_all_and_draws(command, tmp_path):
    path = str(CRANKS)
    done = command("cycloid-fmu", "profile", path, "-o", "d.dxf", "--plot", "d.png", "--chord-error", "0.5 um")
    assert (done.returncode, done.stderr.count("\n")) == (0, 1)
    assert "SVG mark centres, STEP has no hole" in done.stderr
    assert (tmp_path / "d.png").stat().st_size > 20000
    read = command("cycloid-fmu", "profile", path, "-o", "d.svg", "--json")
    assert '"largest_error": 7' in read.stdout
    assert command("cycloid-fmu", "profile", path, "-o", "d.csv").stderr == ""
    assert cy.plot(cy.Drive(make_pair().replace(supports=ROLLERS)).profile()).axes


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["-o", "d.png"], "--output = d.png: the name must end in .dxf or .svg or .csv or .step or .stp."),
        (["-o", "d.dxf", "--disc", "2"], "--disc = 2: it must be between 0 and 1."),
        (["-o", "d.svg", "--chord-error", "0 um"], '--chord-error = "0 um": it must be between 0.001 um and 100 um.'),
        (["-o", "d.svg", "--chord-error", "5"], '--chord-error = "5": write one number with a decimal point'),
    ],
)
def test_bad_input_is_one_sentence(command, words, said):
    done = command("cycloid-fmu", "profile", str(CRANKS), *words)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith(said)
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize(("ending", "module", "extra"), [("dxf", "ezdxf", "cad"), ("step", "OCP", "step")])
def test_a_missing_library_is_named_with_its_extra(command, monkeypatch, ending, module, extra):
    monkeypatch.setitem(sys.modules, module, None)
    done = command("cycloid-fmu", "profile", str(CRANKS), "-o", f"d.{ending}")
    assert done.returncode == 2
    assert done.stderr.startswith(
        f"--output = d.{ending}: this needs the package {module}: pip install 'cycloid-fmu[{extra}]'"
    )


def test_a_hole_that_cuts_the_flank_is_refused():
    wide = {**ROLLERS, "circle_radius": "56 mm"}
    with pytest.raises(edge.InputError, match=r"supports: a hole reaches 61\.31 mm .* cuts the flank"):
        cy.Drive(make_pair().replace(supports=wide)).profile()
    with pytest.raises(edge.InputError, match='chord_error = "1 inchworm": the unit'):
        cy.Drive(make_pair()).profile(chord_error="1 inchworm")
