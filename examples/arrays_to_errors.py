"""From arrays of your own bench to errors
=======================================

If your file format is not supported, NumPy arrays of crank angle, output angle and torque are enough. Here a drive with
known errors replaces the measured one, so that the intervals can be compared with the truth.
"""

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import cycloid_fmu as cy
import fitting

OUT = Path("arrays_to_errors_out")
OUT.mkdir(exist_ok=True)

# %%
# The drive as drawn
# ------------------
# Signs first: torque is that of the environment on the output, and all angles are counter-clockwise seen from the same
# side. With the gear as output the ratio is negative: this output turns once backwards in 39 crank turns.

nominal = cy.Drive(
    cy.Pair(
        gear_teeth=39,
        pin_circle_radius=0.064,
        pin_radius=0.003,
        eccentricity=0.0013,
        face_width=0.010,
        modification={"isometric": -15e-6, "offset": -40e-6},
    )
)
print(f"ratio {nominal.pair.ratio:g}")

# %%
# Four runs as arrays
# -------------------
# Two loads, one low and one high, each in both directions: a low load shows the play and single pins, a high one the
# stiffness. Here a brake produces the torque: it opposes the output, which turns against the crank, so its sign is that
# of the crank's motion. The output encoder has an unknown zero, noise of 0.5 arcsec, and an eccentricity of 0.2 µm on a
# radius of 100 mm.

truth = {"centre_distance_x": 4e-6, "centre_distance_y": -3e-6, "eccentricity": 2e-6, "pin_radius": -1e-6}
made = nominal.replace(errors=truth)
noise = np.random.default_rng(1)


def measured(load: float, direction: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Crank angle, output angle (rad) and torque (N·m) of one run over a whole output turn."""
    crank = direction * np.linspace(0.0, 2.0 * np.pi * 39, 39 * 36)
    torque = direction * load + noise.normal(0.0, 0.1, crank.size)
    error = made.analyze(direction * load, crank_angle=crank).transmission_error.values[0]
    output = crank / nominal.pair.ratio + error
    eccentric = 2e-6 * np.sin(output - 0.7)
    return crank, output + 1e-4 + eccentric + noise.normal(0.0, 0.5 / cy.ARCSEC, crank.size), torque


arrays = {(load, direction): measured(load, direction) for load in (20.0, 200.0) for direction in (1, -1)}
print("shapes of one run:", [array.shape for array in arrays[20.0, 1]])

# %%
# Recordings
# ----------
# A ``fitting.Run`` is a recording made of arrays; a single number applies to all samples. The two flags describe the
# encoders: with ``common_zero`` the output's zero was the same in all runs, with ``known_index`` crank angle 0 is the
# crank at pin 0. Leave them out if you are not sure; both are then fitted.

runs = [
    fitting.Run(
        input_angle=crank,
        output_angle=output,
        torque=torque,
        common_zero=True,
        known_index=True,
        name=f"{load:g} N·m, {'forward' if sign > 0 else 'backward'}",
    )
    for (load, sign), (crank, output, torque) in arrays.items()
]
curves = fitting.curves(runs, nominal)
fitting.plot(curves, OUT / "curves.png")

# %% The errors ---------- Every structured error is identified with its 95 % interval, or held fixed with the reason.

result = fitting.identify(runs, nominal)
fitted = [one for one in result.parameters if one.held is None]
for one in fitted:
    low, high = (1e6 * value for value in one.interval)
    print(f"{one.name:28} {low:+6.2f} … {high:+6.2f} um, really {1e6 * truth.get(one.name, 0.0):+.2f} um")
for one in result.parameters:
    if one.held is not None and "_cos" not in one.name and "_sin" not in one.name:
        print(f"{one.name} is held: {one.held}")
print(f"residual {result.residual * cy.ARCSEC:.2f} arcsec rms, noise {result.noise * cy.ARCSEC:.2f} arcsec")

# %% The residual between measurement and model is the encoder's noise:

fitting.plot(result, OUT / "identified.png")

# %% The intervals compared with the truth:

figure, axis = plt.subplots(figsize=(9, 0.28 * len(fitted) + 1), layout="constrained")
for row, one in enumerate(fitted):
    low, high = (1e6 * value for value in one.interval)
    axis.plot([low, high], [row, row], color="C0", lw=3, label="95 % interval" if row == 0 else None)
    axis.plot(1e6 * truth.get(one.name, 0.0), row, "k|", ms=10, label="truth" if row == 0 else None)
axis.set_yticks(range(len(fitted)), [one.name for one in fitted])
axis.invert_yaxis()
axis.set(xlabel="error [µm]")
axis.grid(alpha=0.3)
axis.legend(loc="lower left")
figure.savefig(OUT / "intervals.png", dpi=150)

# %% ``result.drive`` is a drive like any other; build an FMU of it with ``result.drive.build_fmu("drive.fmu")``.

inside = sum(one.interval[0] <= truth.get(one.name, 0.0) <= one.interval[1] for one in fitted)
print(f"{inside} of {len(fitted)} intervals contain the true value")
