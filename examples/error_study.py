"""Effect of each modification and error on accuracy
=================================================

The error-surface paper's study, and which of its conclusions hold.

One pair, one load, one error at a time. MTE and PPTE are the mean and peak-to-peak transmission error, MB and PPB those
of the backlash, MCS the largest contact pressure; the last columns are the pins in contact. The paper's cases can't be
reproduced (its table of values is not in the text), so the amounts are chosen here: 10 µm, 1 mrad.
"""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import cycloid_fmu as cy

TORQUE, ANGLES = -181.0, 720


def figures(drive):
    data = drive.analyze(TORQUE, angles=ANGLES).isel(torque=0)
    error, backlash, count = (data[n].values for n in ("transmission_error", "backlash", "contact_count"))
    return {
        "MTE": error.mean(),
        "PPTE": np.ptp(error),
        "MB": backlash.mean(),
        "PPB": np.ptp(backlash),
        "MCS": data.max_contact_pressure.values.max(),
        "pins": count.mean(),
        "fewest": count.min(),
        "most": count.max(),
        "load": data.pin_force.values.max(),
    }


def with_errors(drive):
    """One error at a time, each of 10 µm or 1 mrad."""
    pair = drive.pair
    profile = np.cos(2.0 * np.pi * 2.0 * (np.arange(200) + 0.5) / 200)[:, None]
    form = np.broadcast_to(5e-6 * profile, (pair.discs, pair.gear_teeth, 200, 1))
    steps = np.random.default_rng(1).uniform(-5e-6, 5e-6, pair.gear_teeth)
    pitch = np.cumsum(steps - steps.mean())
    return {
        "no error": drive,
        "profile deviation": drive.replace(surface=drive.surface.replace(gear_deviation=form)),
        "pin circle radius": drive.replace(errors={"pin_circle_radius": "10 um"}),
        "pin radius": drive.replace(errors={"pin_radius": "-10 um"}),
        "pitch": drive.replace(errors={"tooth_cumulative_pitch": pitch * 5e-6 / np.abs(pitch).max()}),
        "centre distance": drive.replace(errors={"centre_distance_x": "10 um"}),
        "misalignment": drive.replace(errors={"misalignment_xz": 1e-3}),
    }


def table(title, results):
    print(f"\n{title}")
    print(f"{'case':18}{'MTE ″':>10}{'PPTE ″':>9}{'MB ″':>12}{'PPB ″':>9}{'MCS MPa':>9}{'pins':>7}{'':>8}{'load N':>9}")
    for name, f in results.items():
        mean, span = (f"{f[n] * cy.ARCSEC:.3f}" if np.isfinite(f[n]) else "" for n in ("MB", "PPB"))
        print(
            f"{name:18}{f['MTE'] * cy.ARCSEC:10.3f}{f['PPTE'] * cy.ARCSEC:9.3f}{mean or 'interferes':>12}{span:>9}"
            f"{f['MCS'] * 1e-6:9.0f}{f['pins']:7.1f}{f['fewest']:>5}–{f['most']:<2}{f['load']:9.0f}"
        )


def main() -> None:
    drawn = cy.read_drive(Path(__file__).parent / "drive-39-40.toml")
    kinds = {
        "none": (0, 0),
        "isometric -25": (-25, 0),
        "isometric +25": (25, 0),
        "offset -35": (0, -35),
        "offset +35": (0, 35),
        "compound -25/-70": (-25, -70),
        "compound -50/-140": (-50, -140),
    }
    modified = {n: drawn.replace(isometric=i * 1e-6, offset=o * 1e-6) for n, (i, o) in kinds.items()}
    modifications = {name: figures(drive) for name, drive in modified.items()}
    table("Modifications, µm", modifications)
    erring = with_errors(modified["compound -25/-70"])
    errors = {name: figures(drive) for name, drive in erring.items()}
    table("Errors of 10 µm and 1 mrad on the pair modified by -25/-70 µm", errors)

    none = errors["no error"]
    change = {n: {k: f[k] - none[k] for k in f} for n, f in errors.items() if n != "no error"}
    leading = sorted(change, key=lambda n: -change[n]["PPTE"])
    small, large = modifications["compound -25/-70"], modifications["compound -50/-140"]
    mis, strong = change["misalignment"], [n for n in change if change[n]["PPTE"] > 0.2 * change[leading[0]]["PPTE"]]
    conclusions = {
        "negative isometric with negative offset avoids interference": np.isfinite(small["MB"]),
        "negative isometric only interferes": not np.isfinite(modifications["isometric -25"]["MB"]),
        "more modification: fewer pins, higher stress": large["pins"] < small["pins"] and large["MCS"] > small["MCS"],
        "more modification: higher accuracy": abs(large["MTE"]) < abs(small["MTE"]) and large["PPTE"] < small["PPTE"],
        "pitch dominates PPTE": "pitch" in strong,
        "centre distance dominates PPTE": "centre distance" in strong,
        "misalignment dominates PPTE": "misalignment" in strong,
        "profile and pin circle act on the means": all(
            abs(change[n]["MTE"]) > change[n]["PPTE"] for n in ("profile deviation", "pin circle radius")
        ),
        "pitch and centre distance make the number of pins fluctuate": all(
            errors[n]["most"] - errors[n]["fewest"] > none["most"] - none["fewest"]
            for n in ("pitch", "centre distance")
        ),
        "misalignment: more pins in contact": mis["pins"] > 0,
        "misalignment: an eccentric load, so a higher stress": mis["MCS"] > 0,
    }
    print("\nThe paper's conclusions, on this pair")
    for said, holds in conclusions.items():
        print(f"{said:60}  {'holds' if holds else 'does not hold'}")

    cy.plot(erring[leading[0]].analyze(TORQUE), "error_study_sweep.png")
    figure = Figure(figsize=(10.8, 5.6), layout="constrained")
    for axis, (name, factor, label) in zip(
        figure.subplots(2, 2).flat,
        (
            ("MTE", cy.ARCSEC, "mean TE [″]"),
            ("PPTE", cy.ARCSEC, "peak-to-peak TE [″]"),
            ("PPB", cy.ARCSEC, "peak-to-peak backlash [″]"),
            ("MCS", 1e-6, "contact stress [MPa]"),
        ),
        strict=True,
    ):
        axis.barh(list(change), [c[name] * factor for c in change.values()])
        axis.set_axisbelow(True)
        axis.grid(alpha=0.3)
        axis.set(xlabel=f"change of {label}")
        axis.invert_yaxis()
    figure.savefig("error_study.png", dpi=150)
    print(f"\nDrawn in error_study.png; error_study_sweep.png shows the crank turn with an error of {leading[0]}.")


if __name__ == "__main__":
    main()
