"""First-order effects of errors and loads, as the theory pages state them, against the contact solver."""

import numpy as np
import pytest
from common import PAIR, make_pair

from cycloid_fmu import contact
from cycloid_fmu.analysis import solve
from cycloid_fmu.contact.transmission import rigid_problem
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.surfaces.structured import with_structured
from cycloid_fmu.surfaces.surface import nominal_surface

MODIFIED = PAIR + '[modification]\noffset = "-70 um"\nisometric = "-25 um"\n'


def ideal(phase):
    """K, S and L of the ideal pair, gear out."""
    k = 1.3 * 40 / 64
    stretch = np.sqrt(1.0 + k * k - 2.0 * k * np.cos(phase))
    return k, stretch, 1.3e-3 * 39 * np.sin(phase) / stretch


def gaps(surface):
    drive = rigid_problem(DriveValue(make_pair(), surface))
    rows = contact.contact_rows(drive)
    contact.place_contacts(drive, 0.3, 0.0, rows, True, np.inf, np.inf)
    return rows["gap"][::2]


def test_first_order_effects_on_the_gap():
    """The table of errors.md against differences of the exact gaps, at crank angle 0.3 rad, away from the roots."""
    direction = 2.0 * np.pi * np.arange(40) / 40
    phase = direction - 0.3
    k, s, arm = ideal(phase)
    tooth = np.floor(((direction + 0.3 / 39) % (2.0 * np.pi)) * 39 / (2.0 * np.pi))
    normal = np.exp(0.3j) * (np.cos(phase) - k + 1j * np.sin(phase)) / s
    wanted = {
        "pin_radial_1_cos": (1.0 - k * np.cos(phase)) / s * np.cos(direction),
        "pin_tangential_2_sin": k * np.sin(phase) / s * np.sin(2.0 * direction),
        "pin_radius": -np.ones(40),
        "pin_circle_radius": (1.0 - k * np.cos(phase)) / s,
        "isometric": np.ones(40),
        "offset": -(1.0 - k * np.cos(phase)) / s,
        "eccentricity": (k - np.cos(phase)) / s,
        "centre_distance_x": -normal.real,
        "centre_distance_y": -normal.imag,
        "tooth_cumulative_pitch_1_cos": -arm / 64e-3 * np.cos(2.0 * np.pi * tooth / 39),
    }
    assert -normal.real == pytest.approx(-(np.cos(phase + 0.3) - k * np.cos(0.3)) / s)
    blank, step = nominal_surface(make_pair()), 1e-9
    away = np.abs((phase + np.pi) % (2.0 * np.pi) - np.pi) > 0.3
    for name, effect in wanted.items():
        ends = [gaps(with_structured(blank, {name: v})) for v in (-step, step)]
        found = (ends[1] - ends[0]) / (2.0 * step)
        assert found[away] == pytest.approx(effect[away], abs=1e-4), name


@pytest.mark.parametrize(
    ("name", "order"), [("pin_radial_1_cos", 39), ("tooth_cumulative_pitch_1_cos", 40), ("centre_distance_x", 40)]
)
def test_orders_with_the_ring_as_output(name, order):
    """The gear held: pins at multiples of z_c of an output turn, teeth and fixed errors at multiples of z_p."""
    pair = make_pair(MODIFIED, output="ring")
    surface = with_structured(nominal_surface(pair), {name: 1e-6})
    angles = np.linspace(0.0, 2.0 * np.pi * 40, 40 * 80, endpoint=False)
    error = solve(DriveValue(pair, surface), 100.0, angles, with_play=False).transmission_error[0]
    assert int(np.argmax(np.abs(np.fft.rfft(error))[1:])) + 1 == order


@pytest.mark.parametrize(("law", "dip"), [("capped", 0.17), ("as_printed", 0.27)])
def test_load_dips_at_the_inflection(law, dip):
    """Error-surface paper, figure 7d: one pin near the largest load carries less than both its neighbours."""
    pair = make_pair(contact_law=law)
    angles = np.linspace(0.0, 2.0 * np.pi, 720, endpoint=False)
    force = solve(DriveValue(pair, nominal_surface(pair)), -181.0, angles, with_play=False).pin_force[0, :, 0]
    beside = np.minimum(np.roll(force, 1, axis=1), np.roll(force, -1, axis=1))
    share = np.where(beside > 0.5 * force.max(), 1.0 - force / np.maximum(beside, 1e-9), 0.0)
    assert share.max() == pytest.approx(dip, abs=0.01)
    # It is the pin whose contact is next to where the flank's curvature changes its sign.
    angle, pin = np.unravel_index(share.argmax(), share.shape)
    k = 1.3 * 40 / 64
    inflection = np.arccos((1.0 + 40 * k * k) / (k * 41))
    phase = (2.0 * np.pi * pin / 40 - angles[angle] + np.pi) % (2.0 * np.pi) - np.pi
    assert abs(phase) == pytest.approx(inflection, abs=0.05)
