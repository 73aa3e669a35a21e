"""Tables of an FMU: size against accuracy
=======================================

What the tables take in a native FMU, and what they err against the exact model, by the accuracy asked
for.

The first drive is without errors, so that it repeats from pin to pin; in the second the pins stand as they were made,
and it repeats with every turn of the crank.
"""

import math
import zlib
from pathlib import Path

import numpy as np
from matplotlib.ticker import FixedLocator

from cycloid_fmu.draw.plots import new_figure, save
from cycloid_fmu.edge.commands import print_table
from cycloid_fmu.fmu.variables import Interface, from_tables, variables
from cycloid_fmu.geometry.pair import read_pair
from cycloid_fmu.native import tables
from cycloid_fmu.native.table_file import write
from cycloid_fmu.surfaces.surface import nominal_surface

ARCSEC = math.pi / 648000
ASKED = (1.0, 0.3, 0.1, 0.05, 0.02)

pair = read_pair(Path(__file__).parent / "drive-39-40.toml")
nominal = nominal_surface(pair)
radial = 2e-6 * np.random.default_rng(1).normal(size=pair.pins)
drives = {"pins and teeth alike": nominal, "pins as made": nominal.replace(pin_radial=radial)}

figure, (axes,) = new_figure()
rows = []
for name, surface in drives.items():
    sizes, errors = [], []
    for asked in ASKED:
        made = tables.compute(pair, surface, accuracy=asked * ARCSEC)
        file = write(made, Interface(), from_tables(variables(pair, surface, Interface(), "2.0")))
        sizes.append(len(zlib.compress(file)) / 1e3)
        errors.append(made.largest_error / ARCSEC)
        loads = made.positive.load.size + made.negative.load.size
        rows.append(
            [name, f"{asked:g}″", f"{errors[-1]:.4f}″", f"{sizes[-1]:.0f} kB", f"{loads} × {made.rest_torque.size}"]
        )
    axes.loglog(sizes, errors, "o-", label=name)
    for asked, size, error in zip(ASKED, sizes, errors, strict=True):
        axes.annotate(f"{asked:g}″", (size, error), xytext=(5, 4), textcoords="offset points", fontsize=8, color="0.3")
axes.axhline(0.02, color="0.6", lw=0.8)
axes.text(0.01, 0.02, "what FMUs are built to", transform=axes.get_yaxis_transform(), va="bottom", color="0.4")
for axis, ticks in ((axes.xaxis, (1, 3, 10, 30, 100, 300, 1000)), (axes.yaxis, (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1))):
    axis.set_major_locator(FixedLocator(ticks))
    axis.set_major_formatter("{x:g}")
    axis.set_minor_formatter("")
axes.set_xlabel("tables in the FMU [kB]")
axes.set_ylabel("largest error [arcsec]")
axes.set_title("error of the transmission error; beside each point what was asked for", fontsize=10)
axes.legend()
print_table("tables", ["drive", "asked for", "largest error", "size", "loads × crank angles"], rows)
save(figure, "native_tables.png")
