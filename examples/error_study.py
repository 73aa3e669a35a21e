"""What each modification and error does to accuracy
=================================================

The error-surface paper's study, and which of its conclusions hold.

One pair, one load, one error at a time. MTE and PPTE are the mean and peak-to-peak transmission error, MB and PPB those
of the backlash, MCS the largest contact pressure; the last columns are the pins in contact. The paper's cases can't be
rebuilt (its table of values is not in the text), so the amounts are chosen here: 10 µm, 1 mrad.
"""

import dataclasses
from pathlib import Path

import numpy as np

from cycloid_fmu.contact.transmission import analyze, slices_needed, statistics
from cycloid_fmu.draw.plots import new_figure, save
from cycloid_fmu.edge import ARCSEC
from cycloid_fmu.edge.commands import print_table
from cycloid_fmu.geometry.pair import Modification, read_pair
from cycloid_fmu.surfaces.structured import with_structured
from cycloid_fmu.surfaces.surface import nominal_surface

TORQUE = -181.0
ANGLES = np.linspace(0.0, 2.0 * np.pi, 720, endpoint=False)
RNG = np.random.default_rng(1)


def figures(pair, surface):
    data = analyze(pair, surface, TORQUE, ANGLES, slices_needed(surface), workers=2)
    found = {name: float(value[0]) for name, value in statistics(data).items()}
    count = data["contact_count"].values
    return {
        **found,
        "pins": count.mean(),
        "fewest": count.min(),
        "most": count.max(),
        "load": data["pin_force"].values.max(),
    }


def modified(pair, isometric, offset):
    amounts = Modification.model_construct(isometric=isometric * 1e-6, offset=offset * 1e-6)
    return pair.replace(modification=amounts)


def errors_of(pair):
    """One error at a time, each of 10 µm or 1 mrad."""
    blank, g = nominal_surface(pair), pair
    profile = np.cos(2.0 * np.pi * 2.0 * (np.arange(200) + 0.5) / 200)[:, None]
    steps = RNG.uniform(-5e-6, 5e-6, g.gear_teeth)
    pitch = np.cumsum(steps - steps.mean())
    return {
        "no error": blank,
        "profile deviation": dataclasses.replace(
            blank, gear_deviation=np.broadcast_to(5e-6 * profile, (g.discs, g.gear_teeth, 200, 1)).copy()
        ),
        "pin circle radius": with_structured(pair, blank, {"pin_circle_radius": 1e-5}),
        "pin radius": with_structured(pair, blank, {"pin_radius": -1e-5}),
        "pitch": dataclasses.replace(
            blank, tooth_cumulative_pitch=np.array([pitch * 5e-6 / np.abs(pitch).max()] * g.discs)
        ),
        "centre distance": with_structured(pair, blank, {"centre_distance_x": 1e-5}),
        "misalignment": with_structured(pair, blank, {"misalignment_xz": 1e-3}),
    }


def table(title, results):
    rows = []
    for name, f in results.items():
        free = np.isfinite(f["MB"])
        rows.append([
            name, f"{f['MTE'] * ARCSEC:.3f}", f"{f['PPTE'] * ARCSEC:.3f}",
            f"{f['MB'] * ARCSEC:.3f}" if free else "interferes", f"{f['PPB'] * ARCSEC:.3f}" if free else "",
            f"{f['MCS'] * 1e-6:.0f}", f"{f['pins']:.1f}", f"{f['fewest']}–{f['most']}", f"{f['load']:.0f}",
        ])  # fmt: skip
    columns = ["case", "MTE ″", "PPTE ″", "MB ″", "PPB ″", "MCS MPa", "pins", "", "load N"]
    print_table(title, columns, rows)


def main() -> None:
    drawn = read_pair(Path(__file__).parent / "drive-39-40.toml")
    kinds = {"none": (0, 0), "isometric -25": (-25, 0), "isometric +25": (25, 0), "offset -35": (0, -35),
             "offset +35": (0, 35), "compound -25/-70": (-25, -70), "compound -50/-140": (-50, -140)}  # fmt: skip
    modifications = {n: figures(p := modified(drawn, *a), nominal_surface(p)) for n, a in kinds.items()}
    table("Modifications, µm", modifications)
    pair = modified(drawn, -25, -70)
    errors = {name: figures(pair, surface) for name, surface in errors_of(pair).items()}
    table("Errors of 10 µm and 1 mrad on the pair modified by -25/-70 µm", errors)

    none = errors["no error"]
    change = {n: {k: f[k] - none[k] for k in f} for n, f in errors.items() if n != "no error"}
    leading = sorted(change, key=lambda n: -change[n]["PPTE"])
    small, large = modifications["compound -25/-70"], modifications["compound -50/-140"]
    mis, strong = change["misalignment"], [n for n in change if change[n]["PPTE"] > 0.2 * change[leading[0]]["PPTE"]]
    conclusions = {
        "negative isometric with negative offset avoids interference": np.isfinite(small["MB"]),
        "negative isometric alone interferes": not np.isfinite(modifications["isometric -25"]["MB"]),
        "more modification: fewer pins, higher stress": large["pins"] < small["pins"] and large["MCS"] > small["MCS"],
        "more modification: higher accuracy": abs(large["MTE"]) < abs(small["MTE"]) and large["PPTE"] < small["PPTE"],
        "pitch leads PPTE": "pitch" in strong,
        "centre distance leads PPTE": "centre distance" in strong,
        "misalignment leads PPTE": "misalignment" in strong,
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
    rows = [[said, "holds" if holds else "does not hold"] for said, holds in conclusions.items()]
    print_table("The paper's conclusions, on this pair", ["conclusion", ""], rows)

    figure, axes = new_figure(2, 2)
    for axis, (name, factor, label) in zip(
        axes, (("MTE", ARCSEC, "mean TE [″]"), ("PPTE", ARCSEC, "peak-to-peak TE [″]"),
               ("PPB", ARCSEC, "peak-to-peak backlash [″]"), ("MCS", 1e-6, "contact stress [MPa]")), strict=True,
    ):  # fmt: skip
        axis.barh(list(change), [c[name] * factor for c in change.values()])
        axis.set(xlabel=f"change of {label}")
        axis.invert_yaxis()
    save(figure, "error_study.png")
    print("Drawn in error_study.png")


if __name__ == "__main__":
    main()
