"""A coordinate measuring machine: points of a drive with a known error surface, as its CSV holds them."""

import numpy as np
from scipy.interpolate import RegularGridInterpolator

from cycloid_fmu.geometry.profile import arc_parts, equal_arc_parameters, flank_normals, flank_points


def field(values, along, across):
    """Elements between their middles by straight lines, beyond the outer middles straight on."""
    grids = [(np.arange(n) + 0.5) / n for n in values.shape]
    return RegularGridInterpolator(grids, values, bounds_error=False, fill_value=None)(np.column_stack([along, across]))


def spread(rows, columns):
    """Places in [0, 1]² on a grid of so many rows and columns."""
    return (g.ravel() for g in np.meshgrid((np.arange(rows) + 0.5) / rows, (np.arange(columns) + 0.5) / columns))


def measure(pair, surface, noise, seed, frame=(0.0, 0.0), along=60, across=5, reach=80.0):
    """Return rows (body, disc, number, x, y, z): m, normal noise of this deviation along the normal.

    frame: shift (x + iy, m) and rotation (rad) of every body in the machine's frame; reach: degrees of a pin, each way.
    """
    generator = np.random.default_rng(seed)
    g, (shift, turn), rows = pair, frame, []
    part, width = spread(along, across)
    fine = equal_arc_parameters(pair, 4000)
    alpha = np.interp(part, arc_parts(pair, fine), fine)
    point = np.add(*np.multiply(flank_points(pair, alpha), [[1.0], [1.0j]]))
    normal = np.add(*np.multiply(flank_normals(pair, alpha), [[1.0], [1.0j]]))
    z = (width - 0.5) * g.face_width

    def put(body, disc, number, p):
        p = p * np.exp(1j * turn) + shift
        rows.extend((body, disc, number, *values) for values in zip(p.real, p.imag, z, strict=True))

    for disc in range(g.discs):
        for tooth in range(g.gear_teeth):
            off = generator.normal(0.0, noise, part.size) if noise else np.zeros(part.size)
            if surface.gear_deviation is not None:
                off = off + field(surface.gear_deviation[disc, tooth], part, width)
            at = 2.0 * np.pi * tooth / g.gear_teeth + surface.tooth_cumulative_pitch[disc, tooth] / g.pin_circle_radius
            put("gear", disc, tooth, (point + normal * off) * np.exp(1j * at))
    facing = np.radians((part - 0.5) * 2.0 * reach)
    for pin in range(g.pins):
        off = generator.normal(0.0, noise, part.size) if noise else np.zeros(part.size)
        if surface.pin_deviation is not None:
            off = off + field(surface.pin_deviation[pin], facing / np.pi + 0.5, width)
        radius = g.pin_radius + surface.pin_radius + surface.pin_radius_deviation[pin] + off
        radial = g.pin_circle_radius + surface.pin_circle_radius + surface.pin_radial[pin]
        outwards = np.exp(2j * np.pi * pin / g.pins)
        put("pin", "", pin, outwards * (radial + 1j * surface.pin_tangential[pin] - radius * np.exp(1j * facing)))
    return rows


def write_csv(path, rows, unit="mm", scale=1e3):
    header = f"body,disc,number,x [{unit}],y [{unit}],z [{unit}]"
    lines = [f"{b},{d},{n},{x * scale:.9f},{y * scale:.9f},{z * scale:.9f}" for b, d, n, x, y, z in rows]
    path.write_text("\n".join([header, *lines]) + "\n")
    return path
