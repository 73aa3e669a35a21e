"""Information of the motor's torque about a drive in place, beyond a coarse output encoder: the table of a page.

`python studies/motor_torque.py` prints figures of docs/recalibrate.md. Energy is conserved: with a load T on the output
the motor carries -T (1/ratio + dx/dθ) in addition to its friction, where x is the transmission error over the crank
angle θ. A transmission error of amplitude A and crank order k causes a ripple of T A k in it. The ripple is masked by
cogging, which also has whole crank orders if the motor drives the crank, by gain errors of the current's measurement
(orders 1 and 2 of the electrical turn, in proportion to the load) and noise.
"""

import numpy as np
from lived_drives import ARCSEC

LOAD, TEETH = 181.0, 39  # N·m at the output, teeth
RATED = LOAD / TEETH  # torque of the motor, N·m, without losses
NOISE, COGGING, GAIN = (
    0.01,
    0.015,
    0.01,
)  # over the rated torque; gain: of the current
SAMPLES, BITS = 100 * TEETH, 17  # samples per output turn; bits of the encoder


def ripple(amplitude, order):
    """Amplitude of the motor's torque from a transmission error of an amplitude (rad) and a crank order, N·m."""
    return LOAD * amplitude * order


def told_by_torque(order, turns=1.0, systematic=True):
    """Standard deviation of a transmission error's amplitude from the motor's torque, rad."""
    white = NOISE * RATED * np.sqrt(2.0 / (turns * SAMPLES))
    hidden = np.hypot(COGGING, GAIN) * RATED if systematic else 0.0
    return np.hypot(white, hidden) / (LOAD * order)


def told_by_encoder(turns=1.0):
    """Standard deviation of the same amplitude from a coarse encoder, rad."""
    return 2.0 * np.pi / 2**BITS / np.sqrt(12.0) * np.sqrt(2.0 / (turns * SAMPLES))


def play_by_torque(play, seed, friction=0.02, own=0.03, compliance=2e-6, reversals=20, presliding=0.0):
    """Widths of the torque's dead band at reversals of an unloaded joint, rad at the output, shape (reversals,).

    The motor turns slowly through the play and beyond; friction at the output (relative to the rated torque) holds the
    output until a flank drives it. The shape of a play is fitted to each reversal, with unknown cogging. `presliding`
    is the crank angle over which the motor's own friction reverses, rad.
    """
    generator = np.random.default_rng(seed)
    angle = np.arange(-0.5 * play, 2.5 * play, 2.0 * np.pi / 2**20 / TEETH * 8)  # crank angle, at the output
    orders = np.array([6, 12, 18, 24])
    cosine, sine = generator.normal(0.0, COGGING * RATED / 2.0, (2, orders.size))
    step = friction * RATED

    def shape(width, begin=0.0):
        # One flank loses contact, zero torque over the play, then the other flank is loaded up to the friction.
        wound = np.clip((angle - begin - width) / (compliance * friction * LOAD), 0.0, 1.0)
        return step * wound

    widths = np.linspace(0.2 * play, 1.8 * play, 161)
    found = []
    for _ in range(reversals):
        crank = generator.uniform(0.0, 2.0 * np.pi) + angle * TEETH
        slid = np.maximum(angle - angle[0], 0.0) * TEETH
        own_friction = own * RATED * (1.0 - 2.0 * np.exp(-slid / presliding)) if presliding else 0.0
        torque = shape(play) + own_friction + generator.normal(0.0, NOISE * RATED, angle.size)
        for k, c, s in zip(orders, cosine, sine, strict=True):
            torque += c * np.cos(k * crank) + s * np.sin(k * crank)
        left = [np.linalg.norm(torque - w - np.mean(torque - w)) for w in map(shape, widths)]
        found.append(widths[int(np.argmin(left))])
    return np.array(found)


if __name__ == "__main__":
    print(f"a ripple of 1 arcsec of order 1 is {ripple(ARCSEC, 1) / RATED:.3%} of the motor's torque")
    for order in (1, 2, 3, 10):
        print(
            f"order {order}: by torque {told_by_torque(order) / ARCSEC:.2f}, noise alone "
            f"{told_by_torque(order, systematic=False) / ARCSEC:.2f}, by the encoder "
            f"{told_by_encoder() / ARCSEC:.2f} arcsec"
        )
    for play, degrees in ((60.0, 0.0), (180.0, 0.0), (60.0, 0.3), (180.0, 0.3)):
        every = (
            np.array([play_by_torque(play * ARCSEC, seed, presliding=np.radians(degrees)) for seed in range(20)])
            / ARCSEC
        )
        means = every.mean(axis=1)
        print(
            f"play of {play:g} arcsec, friction turns round within {degrees:g} deg: one reversal {every.std():.1f}, "
            f"mean of 20 off by {means.mean() - play:+.1f} ± {means.std():.1f} arcsec"
        )
