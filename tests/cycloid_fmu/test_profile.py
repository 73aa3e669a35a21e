import numpy as np
import pytest
from common import PAIR, make_pair

from cycloid_fmu import contact
from cycloid_fmu.contact.transmission import rigid_problem
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.geometry.pair import parse_pair, smallest_convex_radius
from cycloid_fmu.geometry.profile import equal_arc_parameters, flank_curvature, flank_normals, flank_points
from cycloid_fmu.surfaces.surface import nominal_surface

MODIFIED = parse_pair(PAIR + '[modification]\noffset = "-50 um"\nisometric = "-30 um"\n', "modified.toml")


@pytest.mark.parametrize("teeth", [6, 13, 39, 87, 120])
@pytest.mark.parametrize("output", ["gear", "ring"])
def test_unmodified_every_gap_is_zero_at_every_crank_angle(teeth, output):
    pair = make_pair(
        gear_teeth=teeth,
        pins=teeth + 1,
        output=output,
        eccentricity=f"{0.6 * 64 / (teeth + 1)} mm",
        pin_radius=f"{0.4 * 64 / (teeth + 1)} mm",
    )
    drive = rigid_problem(DriveValue(pair, nominal_surface(pair)))
    contacts = contact.contact_rows(drive)
    for theta in np.random.default_rng(teeth).uniform(-500.0, 500.0, 200 if teeth != 39 else 1000):
        contact.place_contacts(drive, theta, 0.0, contacts, True, np.inf, np.inf)
        gaps = contacts["gap"][::2]
        assert np.abs(gaps).max() < 1e-12  # 1 nm is asked for


def test_pins_touch_the_flank_that_the_formula_draws():
    """The pin's axis is at its radius from the drawn flank's nearest point, without the kernel's own geometry."""
    pair = make_pair()
    alpha = np.linspace(0.0, 2.0 * np.pi, 150001)
    x, y = flank_points(pair, alpha)
    for theta in (0.0, 0.3, 2.0):
        turn, centre = -theta / 39, 1.3e-3 * np.exp(1j * theta)
        gear = (x + 1j * y) * np.exp(1j * turn) + centre
        pins = 64e-3 * np.exp(2j * np.pi * np.arange(40) / 40)
        nearest = np.abs(gear[:, None] - pins[None, :]).min(axis=0)
        assert nearest == pytest.approx(3e-3, abs=1e-9)


@pytest.mark.parametrize("pair", [make_pair(), MODIFIED])
def test_normals_and_curvature_are_those_of_the_curve(pair):
    alpha = np.linspace(0.01, 0.6, 4001)
    x, y = flank_points(pair, alpha)
    dx, dy = np.gradient(x, alpha, edge_order=2), np.gradient(y, alpha, edge_order=2)
    nx, ny = flank_normals(pair, alpha)
    speed = np.hypot(dx, dy)
    assert np.abs((nx * dx + ny * dy) / speed)[2:-2].max() < 1e-3
    curvature = (dx * np.gradient(dy, alpha) - dy * np.gradient(dx, alpha)) / speed**3
    assert flank_curvature(pair, alpha)[5:-5] == pytest.approx(curvature[5:-5], rel=5e-3, abs=2.0)


def test_elements_have_equal_arc_length():
    pair = MODIFIED
    parameters = equal_arc_parameters(pair, 800)
    assert parameters.shape == (800,)
    x, y = flank_points(pair, parameters)
    steps = np.hypot(np.diff(x), np.diff(y))
    assert steps == pytest.approx(steps.mean(), rel=2e-3)


def test_smallest_convex_radius_is_the_minimum():
    for k, pins in ((0.3, 12), (0.8125, 40), (0.95, 100)):
        c = np.linspace(-1, 1, 200001)
        denominator = 1 + pins * k * k - k * (pins + 1) * c
        radius = np.where(denominator > 0, (1 + k * k - 2 * k * c) ** 1.5 / denominator, np.inf)
        assert smallest_convex_radius(1.0, k / pins, pins) == pytest.approx(radius.min(), rel=1e-6)
