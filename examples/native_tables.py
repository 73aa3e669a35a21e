"""Tables of an FMU: size against accuracy
=======================================

Size of the tables in a native FMU, and their error relative to the exact model, for several accuracies.

The first drive has no errors, so that it repeats from pin to pin; the second has position errors of the pins and
repeats with every crank turn.
"""

import zlib
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator

import cycloid_fmu as cy
from cycloid_fmu.fmu import table_file, tables, variables

ASKED = (1.0, 0.3, 0.1, 0.05, 0.02)  # arcsec

nominal = cy.read_drive(Path(__file__).parent / "drive-39-40.toml")
radial = 2e-6 * np.random.default_rng(1).normal(size=nominal.pair.pins)
drives = {"pins and teeth equal": nominal, "pins as made": nominal.replace(errors={"pin_radial": radial})}

figure = Figure(figsize=(9.0, 3.2), layout="constrained")
axes = figure.subplots()
interface = cy.Interface()
print("drive                │ required  │ largest error │ size   │ loads × crank angles")
for name, drive in drives.items():
    sizes, errors = [], []
    for asked in ASKED:
        made = tables.compute(drive.stage, accuracy=asked / cy.ARCSEC)
        every = variables.variables(drive.stage, interface, "2.0")
        file = table_file.table_body(made, interface, variables.from_tables(every))
        sizes.append(len(zlib.compress(file)) / 1e3)
        errors.append(made.largest_error * cy.ARCSEC)
        loads = made.positive.load.size + made.negative.load.size
        size, angles = f"{sizes[-1]:.0f} kB", made.rest_torque.size
        print(f"{name:20} │ {asked:8g}″ │ {errors[-1]:12.4f}″ │ {size:>6} │ {loads} × {angles}")
    axes.loglog(sizes, errors, "o-", label=name)
    for asked, size, error in zip(ASKED, sizes, errors, strict=True):
        axes.annotate(f"{asked:g}″", (size, error), xytext=(5, 4), textcoords="offset points", fontsize=8, color="0.3")
axes.axhline(0.02, color="0.6", lw=0.8)
axes.text(0.01, 0.02, "default accuracy", transform=axes.get_yaxis_transform(), va="bottom", color="0.4")
for axis, ticks in ((axes.xaxis, (1, 3, 10, 30, 100, 300, 1000)), (axes.yaxis, (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1))):
    axis.set_major_locator(FixedLocator(ticks))
    axis.set_major_formatter("{x:g}")
    axis.set_minor_formatter("")
axes.set_xlabel("tables in the FMU [kB]")
axes.set_ylabel("largest error [arcsec]")
axes.set_title("error of the transmission error, with the required accuracy at each point", fontsize=10)
axes.grid(alpha=0.3)
axes.legend()
figure.savefig("native_tables.png", dpi=150)
