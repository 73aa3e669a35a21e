"""Use from Python
===============

The whole toolkit as a notebook: a pair, its errors, a crank sweep, a tolerance study, an FMU, and back from a bench run
to the errors. Three imports are enough: ``cycloid_fmu`` for the drive, ``drivers`` for encoders, ``fitting`` for
measurements. Quantities are SI numbers or text with a unit everywhere; an impossible value raises an error with the
reason.
"""

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import cycloid_fmu as cy
import drivers
import fitting

OUT = Path("use_from_python_out")
OUT.mkdir(exist_ok=True)

# %%
# A drive and its errors
# ----------------------
# A pair is the design as drawn; a drive is a pair with the errors of the parts as made. Both are immutable and equal if
# their values are; ``replace`` returns a changed copy, validated like a new one.

pair = cy.Pair(
    gear_teeth=39,
    pin_circle_radius="64 mm",
    pin_radius=0.003,
    eccentricity="1.3 mm",
    face_width=0.010,
    rated_torque="181 N*m",
    modification={"isometric": "-15 um", "offset": "-40 um"},
)
nominal = cy.Drive(pair)
made = nominal.replace(errors={"eccentricity": "3 um", "pin_radius": -1e-6, "pin_radial": {2: ("2.5 um", "40 deg")}})
print(nominal)
print(made)

try:
    nominal.replace(eccentricity="1.7 mm")
except cy.InputError as problem:
    print(problem)

# %%
# A crank sweep
# -------------
#
# ``analyze`` returns an xarray dataset over torque and crank angle, in SI units. ``field_units`` converts it to arcsec,
# N·m/arcmin, MPa, µm and degrees.

data = made.analyze(torque=[20, "200 N*m"])
shown = cy.field_units(data)
print(shown)

# %% The picture of ``cycloid-fmu analyze --plot``, and a custom one:

cy.plot(data, OUT / "sweep.png")

# %%

figure, axis = plt.subplots(figsize=(9, 3), layout="constrained")
for name, drive in {"as drawn": nominal, "as made": made}.items():
    error = cy.field_units(drive.analyze("181 N*m", turns=4, angles=4 * 240)).transmission_error[0]
    axis.plot(error.crank_angle, error - error.mean(), lw=1.2, label=name)
axis.set(xlabel="crank angle [°]", ylabel="transmission error\nminus its mean [arcsec]", title="181 N·m")
axis.legend(loc="upper right", ncols=2)
figure.savefig(OUT / "as-made.png", dpi=150)

# %%
# Effect of each error
# --------------------
#
# Derivatives of the transmission error at a load. The mean over a turn is the shift of the output per unit of an error,
# the largest deviation from the mean is the ripple that the error causes.

slope = made.sensitivity("181 N*m", ["eccentricity", "pin_radius", "pin_circle_radius", "pin_radial_1_cos"])
for name, row in zip(slope.error.values, slope.values * cy.ARCSEC * 1e-6, strict=True):
    print(f"{name:18} {row.mean():+6.2f} arcsec/um mean, ± {np.ptp(row) / 2:.2f} over the crank turn")

# %%
# Tolerances
# ----------
# ``sample`` draws one drive within the tolerances, ``study`` solves many and compares them with limits. The 64 drives
# here are few, so the yield's 95 % interval is wide.

tolerances = cy.Tolerances(
    pin_radius={"tolerance": "2 um"},
    eccentricity={"tolerance": "3 um"},
    pin_pitch={"single": "4 um", "cumulative": "12 um"},
    limits={"backlash": "80 arcsec"},
)
print(nominal.sample(tolerances, seed=1))
found = nominal.study(tolerances, ["181 N*m"], samples=64, angles=61, workers=1)
for limit, value in found.yields.items():
    print(limit, {name: round(number, 3) for name, number in value.items()})
cy.plot(found, OUT / "study.png")

# %%
# An FMU
# ------
# The FMU contains the same model: at the same angles it gives the same numbers. ``interface="compliant"`` gives torques
# instead of motion, ``native=True`` an FMU that needs no Python.

made.build_fmu(OUT / "made.fmu")
angle = np.linspace(0.0, 2.0 * np.pi, 90)
simulated = cy.simulate_fmu(OUT / "made.fmu", angle, torque=100.0)["transmission_error"]
difference = np.abs(simulated - made.analyze(100.0, crank_angle=angle).transmission_error.values[0]).max()
print(f"FMU and analysis differ by {difference * cy.ARCSEC:.1e} arcsec at most")

# %%
# A bench run
# -----------
# A simulated bench replaces yours: it turns the FMU and sends CANopen encoder frames over a virtual bus. Record a real
# bench with ``drivers.record("bench.toml", "run.arrows")``.

recordings = []
for seed, (load, direction) in enumerate([(20, "forward"), (-20, "backward"), (200, "forward"), (-200, "backward")]):
    path = OUT / f"{load}Nm.arrows"
    path.unlink(missing_ok=True)
    with drivers.simulate_bench(
        OUT / "made.fmu",
        ratio=pair.ratio,
        torque=load,
        motion=drivers.SimulatedMotion(24, direction, noise="0.5 arcsec", torque_noise=0.2, seed=seed),
        bus="virtual",
    ) as bench:
        done = bench.record(path)
    recordings.append(path)
    print(f"{path.name}: {done.samples['output_angle']} samples")

# %%
# From the bench run to the errors
# --------------------------------
# ``identify`` makes the transmission error curves, selects the errors that the data resolve, fits them, and keeps one
# load back for validation. Errors that the data can't resolve are held fixed, each with the reason.

result = fitting.identify(fitting.read_recordings(recordings), nominal)
for one in result.parameters:
    if one.held is None and one.data_share > 0.9:
        low, high = (1e6 * value for value in one.interval)
        print(f"{one.name:28} {low:+.2f} … {high:+.2f} um")
print(f"kept back: {result.held_out.loads}: {result.held_out.residual * cy.ARCSEC:.2f} arcsec rms residual")
fitting.plot(result, OUT / "identified.png")

# %% ``result.drive`` is a drive like any other: you can analyse, sample and write it, and build an FMU of it.

print(result.drive)
print(f"eccentricity {result.drive.surface.eccentricity * 1e6:.2f} um; the actual value is 3 um")
result.drive.write(OUT / "identified.nc")
result.drive.build_fmu(OUT / "identified.fmu", interface="compliant")
