"""A simulated campaign of a drive with a floating disc, and the predictions of a model of six conditions.

`python studies/simulated_campaign.py` prints the table of docs/identify_coverage.md. Its physics is that of
`second_drive`.
"""

import dataclasses

import numpy as np
import second_drive

import fitting
from cycloid_fmu.drive import Drive
from cycloid_fmu.geometry.pair import Pair
from fitting.transmission_error.spectrum import order_name, significant, spectrum

ARCSEC = np.pi / 648000
TEETH, PINS = 11, 12
SIZES = {"pin_circle_radius": 50e-3, "pin_radius": 5e-3, "eccentricity": 2.5e-3}
WIDTH = 10e-3
ISOMETRIC = 10e-6
BEARING = 1.5e9  # N/m, in every direction
STEEL, ALUMINIUM = 11.5e-6, 23.1e-6  # 1/K
ERRORS = {"eccentricity": 2.0e-6, "centre_distance_x": 4.0e-6, "centre_distance_y": -3.0e-6}
PATTERNS = {
    "pin_radial": 3.0e-6 * np.cos(2.0 * 2.0 * np.pi * np.arange(PINS) / PINS - 0.7),
    "pin_tangential": 2.0e-6 * np.cos(2.0 * np.pi * np.arange(PINS) / PINS + 0.4),
}
LOADS, WARM = (40.0, 80.0, 120.0, 160.0), (20.0, 35.0, 50.0)  # N·m, °C
CALIBRATION = [(load, way, 20.0) for load in (40.0, 80.0, 160.0) for way in (1, -1)]
RIG = {1: (40.0, 1.0), 2: (6.0, 0.3), 3: (3.0, -0.5), 64: (0.8, 1.0)}  # order: amplitude in arcsec, phase
DRIFT = 0.3  # arcsec/K of the rig's zero
NOISE = 0.3 * ARCSEC
EACH, TURNS = 24.37, 2


def body(warm, bearing=BEARING):
    """The drive as made, at a temperature (°C)."""
    grown = {"disc": STEEL, "ring": ALUMINIUM, "pin": ALUMINIUM, "crank": STEEL}
    grown = {name: 1.0 + alpha * (warm - 20.0) for name, alpha in grown.items()}
    cold = second_drive.body({"gear_teeth": TEETH, **SIZES, "face_width": WIDTH}, ERRORS, PATTERNS, bearing=bearing)
    disc = SIZES["pin_radius"] + ISOMETRIC
    ring = SIZES["pin_circle_radius"] * (grown["ring"] - 1.0) * cold.pins / np.abs(cold.pins)
    return dataclasses.replace(
        cold,
        cut=tuple(one * grown["disc"] for one in (SIZES["pin_circle_radius"], disc, SIZES["eccentricity"])),
        pins=cold.pins + ring,
        pin_radius=cold.pin_radius * grown["pin"],
        throw=cold.throw + SIZES["eccentricity"] * (grown["crank"] - 1.0),
    )


def transmission_error(theta, torque, warm=20.0, bearing=BEARING):
    """Rotation (rad) of the disc beyond the ideal one, with its centre held by the bearing's springs."""
    return second_drive.transmission_error(body(warm, bearing), theta, torque)


def recorded(load, way, warm, *, bearing=BEARING, rig=True):
    """A run at a load that turns with the motion, as the rig shows it."""
    noise = np.random.default_rng([int(load), way + 1, int(warm)])
    count = round(TEETH * EACH * TURNS)
    theta = way * np.arange(count) * 2.0 * np.pi / EACH
    error = transmission_error(theta, way * load, warm, bearing)
    output = -theta / TEETH
    if rig:
        error = error + ARCSEC * (DRIFT * (warm - 20.0) + sum(a * np.cos(k * output - p) for k, (a, p) in RIG.items()))
    shown = output + error + noise.normal(0.0, NOISE, count)
    return fitting.Run(
        input_angle=theta,
        output_angle=shown,
        torque=way * load,
        temperature=warm + 273.15,
        common_zero=True,
        known_index=True,
        name=f"{way * load:g} N·m, {warm:g} °C",
    )


def drive():
    """The nominal drive, as a user of the product states it."""
    return Drive(Pair(gear_teeth=TEETH, **SIZES, face_width=WIDTH)).replace(isometric=ISOMETRIC)


def warmed(made, warm):
    """The drive with an aluminium ring and steel inside, all at one temperature."""
    return made.replace(
        temperature={n: f"{warm} degC" for n in ("ring", "pins", "discs", "crank")},
        expansion={"ring": f"{ALUMINIUM} 1/K", "pins": f"{ALUMINIUM} 1/K"},
    )


def left_over(made, load, way, warm, **how):
    """Torque of one condition, measured minus predicted by the drive by itself, and its orders."""
    (curve,) = fitting.curves(recorded(load, way, warm, **how), -float(TEETH))
    predicted = warmed(made, warm).analyze(curve.torque, crank_angle=curve.input_angle)
    left = dataclasses.replace(
        curve, transmission_error=curve.transmission_error - predicted.transmission_error.values[0]
    )
    return curve.torque, left, spectrum(left)


@dataclasses.dataclass(frozen=True)
class Model:
    """A drive, and the remainder of its six conditions: {order: complex amplitudes of `_basis`}.

    Each order above the noise of a condition, and order 0, is a straight line over the torque with a step
    between its signs: the rig's waves, lost motion and windup beside the drive, and how the disc floats.
    """

    found: object
    waves: dict


def _basis(torque):
    return np.array([np.sign(torque), torque, 1.0])


def calibrated(**how):
    """The model of the six conditions: the result of `identify`, and its remainder."""
    found = fitting.identify([recorded(*one, **how) for one in CALIBRATION], drive(), held_out=False)
    seen = [left_over(found.drive, *one, **how) for one in CALIBRATION]
    highest = min(orders.coefficient.size for _, _, orders in seen)
    coefficient = np.array([orders.coefficient[:highest] for _, _, orders in seen])
    out = np.any([orders.significant[:highest] for _, _, orders in seen], axis=0)
    out[0] = True
    basis = np.array([_basis(torque) for torque, _, _ in seen])
    return Model(found, {int(k): np.linalg.lstsq(basis, coefficient[:, k], rcond=None)[0] for k in np.flatnonzero(out)})


def misses(model, load, way, warm, **how):
    """Root mean square (arcsec) of the error in one condition, and of its orders by their cause.

    "rig", "pin", "tooth", "mesh" as the spectra of a report name them, "" for orders of another number, "mean" for
    order 0, "noise" for the rest without significant orders; "orders" lists the significant ones, the largest first.
    """
    torque, curve, orders = left_over(model.found.drive, load, way, warm, **how)
    turned = curve.input_angle / TEETH
    known = sum(np.real(_basis(torque) @ parts * np.exp(1j * k * turned)) for k, parts in model.waves.items())
    left = curve.transmission_error - known
    orders = spectrum(dataclasses.replace(curve, transmission_error=left))
    out = significant(orders.coefficient, orders.floor, orders.floor.size)
    by = dict.fromkeys(("rig", "pin", "tooth", "mesh", ""), 0.0)
    for k in np.flatnonzero(out):
        by[order_name(int(k), -TEETH, model.found.drive.pair)] += 0.5 * orders.amplitude[k] ** 2
    mean = float(orders.coefficient[0].real)
    rest = max(float(np.mean(left**2)) - mean**2 - sum(by.values()), 0.0)
    leading = [int(k) for k in np.argsort(-orders.amplitude) if out[k]]
    return {
        "all": np.sqrt(np.mean(left**2)) / ARCSEC,
        "mean": mean / ARCSEC,
        **{kind: np.sqrt(v) / ARCSEC for kind, v in by.items()},
        "noise": np.sqrt(rest) / ARCSEC,
        "orders": leading,
    }


def predicted_conditions():
    """The conditions of the campaign that no model was calibrated with."""
    return [
        (load, way, warm) for warm in WARM for load in LOADS for way in (1, -1) if (load, way, warm) not in CALIBRATION
    ]


def table(**how):
    """Lines of the table of docs/identify_coverage.md."""
    model = calibrated(**how)
    yield "| predicted | miss | mean | rig | pins | teeth | mesh | others | none | orders left, the largest first |"
    yield "| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |"
    for load, way, warm in predicted_conditions():
        m = misses(model, load, way, warm, **how)
        cells = [f"{m[k]:.2f}" for k in ("all", "mean", "rig", "pin", "tooth", "mesh", "", "noise")]
        orders = ", ".join(map(str, m["orders"][:5]))
        yield f"| {way * load:g} N·m, {warm:g} °C | {' | '.join(cells)} | {orders} |"


if __name__ == "__main__":
    for line in table():
        print(line, flush=True)
