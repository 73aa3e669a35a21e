"""Draws the figure of signs and axes, `docs/_static/signs.svg`, from the geometry itself: `python docs/signs.py`."""

from pathlib import Path

import numpy as np

import cycloid_fmu as cy

OUT = Path(__file__).parent / "_static" / "signs.svg"
# Few teeth and a long crank, so that all of it can be seen.
PAIR = cy.Pair(gear_teeth=9, pin_circle_radius="64 mm", pin_radius="6.5 mm", eccentricity="4.5 mm", face_width="10 mm")
THETA = np.radians(72.0)
SCALE, MIDDLE = 3.55e3, 330 + 322j  # pixels a metre; of the pin circle
HALO = 'stroke="#e8eef6" stroke-width="7" paint-order="stroke"'  # a label lets no line through
BLUE, RED, GREEN, GREY = "#1258a8", "#b3261e", "#1d7a3c", "#666"


def at(point: complex) -> complex:
    """Return a point (m) in the picture, whose y points downwards."""
    return MIDDLE + SCALE * np.conj(point)


def path(points: np.ndarray, style: str) -> str:
    """Return a line through points (m)."""
    return f'<path d="M{" L".join(f"{p.real:.1f} {p.imag:.1f}" for p in at(points))}" {style}/>'


def text(point: complex, words: str, colour: str = "#111", anchor: str = "middle", halo: str = "") -> str:
    """Return words whose middle is at a point (m)."""
    p = at(point)
    style = f'fill="{colour}" text-anchor="{anchor}" dominant-baseline="central" {halo}'
    return f'<text x="{p.real:.1f}" y="{p.imag:.1f}" {style}>{words}</text>'


def arrow(points: np.ndarray, colour: str, width: float = 3.0) -> str:
    """Return a line that ends in a head."""
    end, before = at(points[-1]), at(points[-2])
    step = (end - before) / abs(end - before)
    head = [end + 4 * step, end - 10 * step + 6j * step, end - 10 * step - 6j * step]
    corners = " ".join(f"{p.real:.1f},{p.imag:.1f}" for p in head)
    line = path(points, f'fill="none" stroke="{colour}" stroke-width="{width}"')
    return line + f'<polygon points="{corners}" fill="{colour}"/>'


def straight(begin: complex, step: complex, colour: str) -> str:
    """Return a straight arrow (m)."""
    return arrow(begin + step * np.array([0.0, 0.9, 1.0]), colour)


def arc(centre: complex, radius: float, begin: float, end: float, colour: str) -> str:
    """Return an arrow round a centre (m, rad)."""
    return arrow(centre + radius * np.exp(1j * np.linspace(begin, end, 60)), colour)


def signs() -> str:
    """Return the figure as SVG: at torque 0 the drive of `PAIR` as the product places it."""
    motion = cy.Drive(PAIR).motion(0.0, THETA)
    disc, turn = motion.centre[0, 0, 0], motion.rotation[0, 0, 0]
    teeth = disc + np.exp(1j * turn) * motion.made[0]  # (teeth, profile)
    circle, pins = PAIR.pin_circle_radius, motion.pin_axis[0, 0]
    drawn = [
        path(teeth.ravel(), 'fill="#e8eef6" stroke="#345" stroke-width="1.6"'),
        straight(0.0, 1.36 * circle, GREY),
        straight(0.0, 1.36j * circle, GREY),
        text(1.36 * circle + 3.6e-3, "x", GREY),
        text(1.36j * circle + 4.4e-3, "y", GREY),
    ]
    for pin, axis in enumerate(pins):
        p = at(axis)
        drawn.append(
            f'<circle cx="{p.real:.1f}" cy="{p.imag:.1f}" r="{SCALE * motion.pin_radius[pin]:.1f}" fill="#fff" '
            'stroke="#345" stroke-width="1.6"/>'
        )
        drawn.append(text(axis, str(pin)))
    for tooth in range(PAIR.gear_teeth):
        middle = teeth[tooth, teeth.shape[1] // 2]
        drawn.append(text(disc + 0.83 * (middle - disc), str(tooth), BLUE, halo=HALO))
    # The crank, its angle, and the root at which the teeth begin.
    crank = np.exp(1j * THETA)
    drawn += [
        path(np.array([0.0, 0.5 * circle * crank]), f'stroke="{RED}" stroke-width="1.6" stroke-dasharray="6 5"'),
        path(np.array([0.0, disc]), f'stroke="{RED}" stroke-width="5"'),
        arc(0.0, 0.42 * circle, 0.0, THETA, RED),
        text(0.5 * circle * np.exp(0.55j * THETA), "θ", RED),
        path(np.array([disc, teeth[0, 0]]), f'stroke="{BLUE}" stroke-width="1.6" stroke-dasharray="6 5"'),
    ]
    for point, words, shift in (
        (0.0, "O<tspan dy='5' font-size='15'>f</tspan>", -4.4e-3 - 4.2e-3j),
        (disc, "O<tspan dy='5' font-size='15'>c</tspan>", -6.4e-3 + 1.5e-3j),
    ):
        p = at(point)
        drawn.append(f'<circle cx="{p.real:.1f}" cy="{p.imag:.1f}" r="4.5" fill="#111"/>')
        drawn.append(text(point + shift, words))
    # The output and the torque on it.
    drawn += [
        arc(disc, 0.44 * circle, np.radians(195), np.radians(262), BLUE),
        text(disc + 0.34 * circle * np.exp(1j * np.radians(226)), "φ<tspan dy='5' font-size='15'>b</tspan>", BLUE),
        arc(disc, 0.58 * circle, np.radians(272), np.radians(322), BLUE),
        text(disc + 0.47 * circle * np.exp(1j * np.radians(300)), "T", BLUE),
    ]
    # Errors of a pin and of a tooth, each with the sign that is above zero.
    pin = pins[1]
    out, onward = pin / abs(pin), 1j * pin / abs(pin)
    drawn += [
        straight(pin + 0.011 * out, 0.014 * out, GREEN),
        text(pin + 0.030 * out, "radial", GREEN),
        straight(pin + 0.011 * onward, 0.016 * onward, GREEN),
        text(pin + 0.027 * onward + 0.004 * out, "tangential", GREEN, "start"),
    ]
    tooth = np.angle(teeth[6, teeth.shape[1] // 2] - disc)
    reach = 0.665 * circle
    drawn += [
        arc(disc, reach, tooth - 0.16, tooth + 0.22, GREEN),
        text(disc + 0.54 * circle * np.exp(1j * (tooth + 0.02)), "pitch", GREEN),
    ]
    note = "all arrows show the sign &gt; 0; z points out of the page"
    drawn.append(f'<text x="330" y="614" text-anchor="middle" fill="{GREY}" font-size="19">{note}</text>')
    title = "Frame, crank angle, output angle, torque, numbers of pins and teeth, and directions of errors"
    return (
        '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 660 634" role="img" font-family="sans-serif" '
        f'font-size="21">\n<title>{title}</title>\n<rect width="660" height="634" fill="#fff"/>\n'
        + "\n".join(drawn)
        + "\n</svg>\n"
    )


if __name__ == "__main__":
    OUT.write_text(signs(), encoding="utf-8")
