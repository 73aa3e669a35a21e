"""Plots of what this package computes; every function returns a matplotlib figure."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu.draw.figure import new_figure, show_legend
from cycloid_fmu.draw.figure import save as save  # commands write what they draw
from cycloid_fmu.edge import ARCMIN, ARCSEC

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.figure import Figure

    from cycloid_fmu.geometry.pair import Pair
    from cycloid_fmu.supports.figures import Share
    from cycloid_fmu.wear.progress import WearModel, WearRate, WearState


def plot(result: object, path: str | os.PathLike[str] | None = None) -> Figure:
    """Draw a result, and write the picture where a path is given.

    Parameters
    ----------
    result
        What `Drive.analyze`, `study`, `sweep`, `wear`, `profile` or `budget` returned, a drive or an error surface.
    path
        PNG or PDF by its ending.

    Raises
    ------
    TypeError
        If it is none of these.
    edge.InputError
        If the path has another ending.

    Examples
    --------
    >>> import cycloid_fmu as cy, pathlib
    >>> pair = cy.Pair(
    ...     gear_teeth=39, pin_circle_radius="64 mm", pin_radius="3 mm", eccentricity="1.3 mm", face_width="10 mm"
    ... )
    >>> _ = cy.plot(cy.Drive(pair).analyze(100.0, angles=45), "sweep.png")
    >>> pathlib.Path("sweep.png").stat().st_size > 20000
    True
    """
    import xarray as xr

    from cycloid_fmu.cad.profile import Profile
    from cycloid_fmu.draw.profiles import plot_profile
    from cycloid_fmu.draw.sweeps import plot_sweep
    from cycloid_fmu.studies.sweep import FORMAT as SWEEP
    from cycloid_fmu.studies.yields import Findings
    from cycloid_fmu.surfaces.surface import ErrorSurface
    from cycloid_fmu.wear.life import WearRun

    if isinstance(result, xr.Dataset):
        figure = plot_sweep(result) if result.attrs.get("format") == SWEEP else plot_analysis(result)
    elif isinstance(result, Profile):
        figure = plot_profile(result)
    elif isinstance(result, Findings):
        figure = plot_tolerance(result.result)
    elif isinstance(result, WearRun):
        figure = plot_wear(result.model, result.states, result.new, result.figures)
    elif isinstance(result, ErrorSurface) or isinstance(getattr(result, "surface", None), ErrorSurface):
        figure = plot_surface(getattr(result, "surface", result))
    elif isinstance(result, Mapping) and "standard" in result:
        figure = plot_budget(result)
    else:
        raise TypeError(f"result is a {type(result).__name__}: there is no picture of it")
    if path is not None:
        save(figure, path)
    return figure


def plot_bearings(data: xr.Dataset, pair: Pair, shares: Sequence[Share]) -> Figure:
    """Forces of the bearings and shifts of the discs over the crank, and where compliance and lost motion come from."""
    from cycloid_fmu.supports.figures import remaining

    figure, axes = new_figure(3, 2)
    angle = np.degrees(data["crank_angle"].values)
    first = data.isel(torque=0)
    arms = first["turning_arm_force"].values.reshape(angle.size, -1)
    shafts = first["crank_bearing_force"].values.reshape(angle.size, -1)
    arm = "turning arms" if pair.supports is not None and pair.supports.kind == "cranks" else "eccentric bearings"
    cranks = shafts.shape[1]
    main = first["main_bearing_force"].values[:, None]
    panels = ((axes[0], arms, arm), (axes[1], shafts, "crank bearings"), (axes[2], main, "main bearing"))
    for axis, values, name in panels:
        for number, force in enumerate(values.T):
            each = f"disc {number // cranks}" + (f", crank {number % cranks}" if cranks > 1 else "")
            which = each if axis is axes[0] else f"crank {number}"
            axis.plot(angle, force, lw=1.0, label=which if values.shape[1] > 1 else None)
        if 1 < values.shape[1] <= 9:
            show_legend(axis, ncols=3, fontsize=7)
        axis.set(xlabel="crank angle [°]", ylabel="force [N]", title=f"{name}, {float(first['torque']):g} N·m")
    for disc in data["disc"].values:
        one = first.sel(disc=disc)
        axes[3].plot(one["disc_shift_x"] * 1e6, one["disc_shift_y"] * 1e6, lw=1.0, label=f"disc {disc}")
    axes[3].set(xlabel="x [µm]", ylabel="y [µm]", title="shift of each disc's centre")
    axes[3].set_aspect("equal", "datalim")
    show_legend(axes[3])
    soft = {share.part: share.compliance * 1e6 for share in shares}
    left = math.nan if pair.supports is None else remaining(pair.supports, shares)
    if soft and not math.isnan(left):
        soft["left to the catalogue's"] = left * 1e6
    lost = {share.part: share.lost_motion * ARCMIN for share in shares}
    for axis, lengths, label in ((axes[4], soft, "compliance [µrad/(N·m)]"), (axes[5], lost, "lost motion [arcmin]")):
        axis.barh(list(lengths), list(lengths.values()), color="#4c78a8")
        axis.invert_yaxis()
        axis.set(xlabel=label, title="as drawn, part by part" + (", at 20 °C" if "temperature" in data.attrs else ""))
        if not lengths:
            axis.text(0.5, 0.5, "needs a rated torque", ha="center", transform=axis.transAxes)
    _show_temperature(figure, data)
    return figure


def plot_analysis(data: xr.Dataset) -> Figure:
    """Transmission error, backlash, contacting pins and largest pressure over the crank, and the load of each pin."""
    figure, axes = new_figure(3, 2)
    angle = np.degrees(data["crank_angle"].values)
    panels: Mapping[str, tuple[str, float]] = {
        "transmission_error": ("transmission error [arcsec]", ARCSEC),
        "backlash": ("backlash [arcsec]", ARCSEC),
        "contact_count": ("pins in contact", 1.0),
        "max_contact_pressure": ("largest pressure [MPa]", 1e-6),
        "torsional_stiffness": ("stiffness [N·m/arcmin]", 1.0 / ARCMIN),
    }
    if "turning_arm_force" not in data:
        panels = {**panels, "torsional_stiffness": ("mesh stiffness, rigid bodies\n[N·m/arcmin]", 1.0 / ARCMIN)}
    single = ("backlash",)
    for axis, (name, (label, factor)) in zip(axes, panels.items(), strict=False):
        for torque in data["torque"].values[: 1 if name in single else None]:
            values = data[name].sel(torque=torque).values * factor
            axis.plot(angle, values, lw=1.2, label=f"{torque:g} N·m")
        axis.set(xlabel="crank angle [°]", ylabel=label)
        if np.isnan(data[name].values).all():
            axis.text(0.5, 0.5, "no free position (interference)", ha="center", transform=axis.transAxes)
    show_legend(axes[0])
    forces = data["pin_force"].isel(torque=0, disc=0)
    image = axes[5].pcolormesh(angle, data["pin"].values, forces.values.T, cmap="viridis", shading="nearest")
    torque = data["torque"].values[0]
    axes[5].set(xlabel="crank angle [°]", ylabel="pin", title=f"force of each pin, {torque:g} N·m, disc 0")
    axes[5].title.set_fontsize(9)
    figure.colorbar(image, ax=axes[5], label="N")
    _show_temperature(figure, data)
    return figure


def _show_temperature(figure: Figure, data: xr.Dataset) -> None:
    if "temperature" in data.attrs:
        figure.suptitle(data.attrs["temperature"], fontsize=9)


def plot_lines(data: xr.Dataset) -> Figure:
    """Contact lines at one crank angle, the load around the pin circle, and the pressures that elements have seen."""
    figure, axes = new_figure(2, 2)
    torque = float(data["torque"].values[0])
    one = data.isel(torque=0, disc=0)
    forces = one["pin_force"].max("crank_angle").values
    figure.delaxes(axes[0])
    polar = figure.add_subplot(2, 2, 1, projection="polar")
    around = 2.0 * np.pi * data["pin"].values / data.sizes["pin"]
    polar.bar(around, one["pin_force"].isel(crank_angle=0).values, width=0.9 * around[1])
    polar.plot(np.append(around, around[0]), np.append(forces, forces[0]), "k.", ms=3)
    polar.set_title(f"force of each pin at the first crank angle, N\n(dots: largest), {torque:g} N·m", fontsize=9)
    z = data["slice"].values * 1e3
    line = one["slice_force"].isel(crank_angle=0)
    for pin in np.argsort(-line.sum("slice").values)[:5]:
        width = z[1] - z[0] if z.size > 1 else 1.0
        axes[1].step(z, line.values[pin] / width, where="mid", label=f"pin {pin}")
    axes[1].set(xlabel="across the face [mm]", ylabel="line load [N/mm]", title="contact lines, first crank angle")
    show_legend(axes[1])
    flank = one["gear_element_pressure"].max("tooth").values * 1e-6
    pins = data["pin_element_pressure"].isel(torque=0).max("pin").values * 1e-6
    edges = [z.min() - 1e-9, z.max() + 1e-9]
    for axis, image, extent, label in (
        (axes[2], flank, [*edges, 0.0, 1.0], "tooth: share of the arc"),
        (axes[3], pins, [*edges, -90.0, 90.0], "pin: angle from the centre [°]"),
    ):
        shown = axis.imshow(image, extent=extent, origin="lower", aspect="auto", cmap="magma", interpolation="nearest")
        axis.set(xlabel="across the face [mm]", ylabel=label)
        axis.grid(visible=False)
        figure.colorbar(shown, ax=axis, label="largest pressure [MPa]")
    axes[2].set_title("over all teeth and crank angles", fontsize=9)
    axes[3].set_title("over all pins and crank angles", fontsize=9)
    _show_temperature(figure, data)
    return figure


def plot_surface(surface: object) -> Figure:
    """Position and radius errors of the pins, cumulative pitch of the teeth, and the elements' deviations if any.

    Of the flanks the mean of all teeth and tooth 0 of disc 0 are drawn, of the pins the mean and pin 0.
    """
    from cycloid_fmu.surfaces.surface import ErrorSurface

    assert isinstance(surface, ErrorSurface)
    maps = []
    if surface.gear_deviation is not None:
        teeth = surface.gear_deviation.reshape(-1, *surface.gear_deviation.shape[2:])
        along = ("profile, root to root", (0.0, 1.0))
        maps += [("mean of all teeth", teeth.mean(axis=0), along), ("tooth 0, disc 0", teeth[0], along)]
    if surface.pin_deviation is not None:
        along = ("angle from the circle's centre [°]", (-90.0, 90.0))
        maps += [("mean of all pins", surface.pin_deviation.mean(axis=0), along)]
        maps += [("pin 0", surface.pin_deviation[0], along)]
    figure, axes = new_figure(1 + len(maps) // 2, 2) if maps else new_figure(2)
    for name, label in (("pin_radial", "radial"), ("pin_tangential", "tangential"), ("pin_radius_deviation", "radius")):
        axes[0].plot(getattr(surface, name) * 1e6, "o-", ms=3, lw=1, label=label)
    axes[0].set(xlabel="pin", ylabel="error [µm]")
    show_legend(axes[0])
    for disc, pitch in enumerate(surface.tooth_cumulative_pitch):
        axes[1].plot(pitch * 1e6, "o-", ms=3, lw=1, label=f"disc {disc}")
    axes[1].set(xlabel="tooth", ylabel="cumulative pitch [µm]")
    show_legend(axes[1])
    for axis, (title, elements, (label, ends)) in zip(axes[2:], maps, strict=True):
        largest = max(np.abs(elements).max() * 1e6, 1e-3)
        image = axis.imshow(
            elements.T * 1e6, origin="lower", aspect="auto", extent=(*ends, -0.5, 0.5), cmap="RdBu_r", vmin=-largest,
            vmax=largest,
        )  # fmt: skip
        axis.set(xlabel=label, ylabel="part of the width")
        axis.set_title(f"deviation, {title}", fontsize=9)
        axis.grid(False)
        figure.colorbar(image, ax=axis, label="µm")
    return figure


def plot_budget(found: Mapping[str, Mapping[str, float]], stack: object = None) -> Figure:
    """Pareto chart of a lost motion budget's terms, closed form beside contact model, and below how the total scatters.

    The line is the closed form's cumulative share of all terms' amounts; `stack` is a `reducer.Stack` or None.
    """
    from cycloid_fmu.reducer.lost_motion import TERMS
    from cycloid_fmu.reducer.stack import Stack

    closed, exact = found["standard"], found["geometric_sun_locked"]
    names = sorted(TERMS, key=lambda n: -abs(closed[n]))
    names = [n for n in names if closed[n] != 0.0 or exact[n] != 0.0]
    figure, axes = new_figure(3 if stack is None else 5)
    for axis in axes:
        figure.delaxes(axis)
    grid = figure.add_gridspec(3 if stack is None else 5, 1)
    axis = figure.add_subplot(grid[:3])
    place = np.arange(len(names))
    for shift, terms, label in ((-0.2, closed, "closed form"), (0.2, exact, "contact model, sun locked")):
        axis.bar(
            place + shift, [terms[n] * ARCMIN for n in names], 0.38, label=f"{label}: {terms['total'] * ARCMIN:.3f}′"
        )
    axis.axhline(0.0, color="k", lw=0.8)
    axis.set(ylabel="play at the output [arcmin]")
    axis.set_xticks(place, [n.replace("_", "\n") for n in names], fontsize=7)
    axis.grid(alpha=0.3, axis="y")
    show_legend(axis, loc="lower right")
    share = axis.twinx()
    amounts = np.abs([closed[n] for n in names])
    share.plot(place, 100.0 * np.cumsum(amounts) / amounts.sum(), "k.-", lw=1)
    share.set(ylabel="closed form, cumulative share [%]", ylim=(0.0, 105.0))
    if stack is not None:
        assert isinstance(stack, Stack)
        axis = figure.add_subplot(grid[3:])
        for name, label in (("standard", "closed form"), ("geometric", "contact model, sun locked")):
            axis.hist(stack.samples[name] * ARCMIN, bins=40, alpha=0.5, density=True, label=label)
        for span, label, height in (
            (stack.worst_case, "worst case", 0.9),
            (stack.root_sum_square, "root sum square", 0.95),
        ):
            axis.plot([v * ARCMIN for v in span], [height] * 2, "|-", transform=axis.get_xaxis_transform(), label=label)
        axis.set(xlabel="total play [arcmin]", ylabel="density", ylim=(0.0, 1.2 * axis.get_ylim()[1]))
        show_legend(axis, ncols=4, loc="lower left", bbox_to_anchor=(0.0, 1.0))
        axis.grid(alpha=0.3)
    return figure


# unit of a tolerance study's figures: for people, with its factor
SHOWN = {"rad": ("arcsec", ARCSEC), "Pa": ("MPa", 1e-6), "m": ("µm", 1e6)}


def plot_tolerance(result: object) -> Figure:
    """Distribution of every figure of a tolerance study, with its limit and the share of drives that keep it.

    A figure that has no limit and is the same in all drives is left out.
    """
    from cycloid_fmu.studies.tolerance import FIGURES, PER_TORQUE, Result, yields

    assert isinstance(result, Result)
    study = result.study
    limits, kept = study.tolerances.limits.stated(), yields(result)
    every = list(dict.fromkeys(n for n, _ in study.columns))
    names = [n for n in every if n in limits or np.ptp(result.figure(n)) > 0.0] or every
    figure, axes = new_figure((len(names) + 1) // 2, 2)
    for axis in axes[len(names) :]:
        figure.delaxes(axis)
    for axis, name in zip(axes, names, strict=False):
        unit, factor = SHOWN[FIGURES[name][0]]
        values = result.figure(name)[result.independent] * factor
        for k, column in enumerate(values.reshape(len(values), -1).T):
            label = f"{study.torque[k]:g} N·m" if name in PER_TORQUE else None
            axis.hist(column, bins="auto", histtype="stepfilled", alpha=0.5, label=label)
        if name in limits:
            axis.axvline(
                limits[name] * factor, color="k", ls="--", lw=1, label=f"limit: {kept[name]['share']:.1%} keep it"
            )
        axis.set(xlabel=f"{name.replace('_', ' ')} [{unit}]", ylabel="drives")
        if axis.get_legend_handles_labels()[0]:
            show_legend(axis)
    return figure


def plot_indices(factors: Sequence[str], indices: Mapping[str, Mapping[str, NDArray[np.float64]]]) -> Figure:
    """First-order and total Sobol index of each tolerance for each figure, with their 95 % intervals."""
    figure, axes = new_figure((len(indices) + 1) // 2, 2)
    for axis in axes[len(indices) :]:
        figure.delaxes(axis)
    place = np.arange(len(factors))
    for axis, (name, found) in zip(axes, indices.items(), strict=False):
        for shift, kind in ((-0.2, "first_order"), (0.2, "total")):
            axis.bar(place + shift, found[kind], 0.38, yerr=found[f"{kind}_confidence"], capsize=2,
                     error_kw={"lw": 0.8}, label=kind.replace("_", " "))  # fmt: skip
        axis.set_xticks(place, [f.replace("_", " ") for f in factors], rotation=60, ha="right", fontsize=7)
        axis.set(ylabel="Sobol index")
        axis.set_title(name.replace("_", " "), fontsize=9)
    show_legend(axes[0])
    figure.set_size_inches(figure.get_figwidth(), 1.4 * figure.get_figheight())
    return figure


def plot_allocation(factors: Sequence[str], scale: NDArray[np.float64], title: str) -> Figure:
    """Width of each allocated tolerance relative to the stated one; narrower to the left of the line, wider beyond."""
    figure, axes = new_figure(2)
    figure.delaxes(axes[1])
    axis = axes[0]
    axis.set_subplotspec(figure.add_gridspec(1, 1)[0])
    place = np.arange(len(factors))[::-1]
    axis.barh(place, scale - 1.0, left=1.0, color=np.where(scale < 1.0, "C3", "C2"))
    axis.axvline(1.0, color="k", lw=0.8)
    axis.set_xscale("log")
    ticks = [t for t in (0.1, 0.2, 0.5, 0.7, 1.0, 1.5, 2.0, 4.0) if 0.8 * scale.min() < t < 1.3 * scale.max()]
    axis.set_xticks(ticks, [f"{t:g}" for t in ticks])
    axis.minorticks_off()
    axis.set_yticks(place, [f.replace("_", " ") for f in factors])
    axis.set(xlabel="allocated tolerance / stated tolerance")
    axis.set_title(title, fontsize=9)
    return figure


def plot_simulation(results: Mapping[str, NDArray[np.float64]]) -> Figure:
    """Output angle's error, backlash and largest pressure of an FMU's run over time."""
    figure, axes = new_figure(3, sharex=True)
    time = results["time"]
    for axis, (name, label, factor) in zip(
        axes,
        (
            ("transmission_error", "transmission error [arcsec]", ARCSEC),
            ("backlash", "backlash [arcsec]", ARCSEC),
            ("max_contact_pressure", "largest pressure [MPa]", 1e-6),
        ),
        strict=True,
    ):
        axis.plot(time, results[name] * factor, lw=1.2)
        axis.set(ylabel=label)
    axes[-1].set(xlabel="time [s]")
    return figure


# What differences of an FMU's variables are shown in.
DIFFERENCE_UNITS = {
    "flange_a.phi": ("arcsec", ARCSEC), "flange_b.phi": ("arcsec", ARCSEC), "transmission_error": ("arcsec", ARCSEC),
    "backlash": ("arcsec", ARCSEC), "flange_a.w": ("rad/s", 1.0), "flange_b.w": ("rad/s", 1.0),
    "flange_a.tau": ("N·m", 1.0), "flange_b.tau": ("N·m", 1.0), "torsional_stiffness": ("N·m/arcmin", 1.0 / ARCMIN),
    "max_contact_pressure": ("MPa", 1e-6), "power_loss": ("W", 1.0), "elastic_energy": ("J", 1.0),
    "dissipated_energy": ("J", 1.0),
}  # fmt: skip


def plot_comparison(
    time: NDArray[np.float64],
    pairs: Mapping[str, tuple[NDArray[np.float64], NDArray[np.float64]]],
    one: str,
    other: str,
) -> Figure:
    """Difference of each variable that two FMUs, or an FMU and a recording, have in common, over time."""
    figure, axes = new_figure((len(pairs) + 1) // 2, 2, sharex=True)
    for axis, (name, (first, second)) in zip(axes, pairs.items(), strict=False):
        unit, factor = DIFFERENCE_UNITS.get(name, ("", 1.0))
        axis.plot(time, (first - second) * factor, lw=1.0)
        axis.set(ylabel=f"{name} [{unit}]")
    for axis in axes[len(pairs) :]:
        axis.set_axis_off()
    for axis in axes[-2:]:
        axis.set(xlabel="time [s]")
    figure.suptitle(f"{one} less {other}")
    return figure


def plot_wear(model: WearModel, states: list[WearState], new: WearRate, figures: Mapping[str, Any]) -> Figure:
    """Mesh of one pin when new, wear depth over both bodies, and depth and accuracy over life."""
    from cycloid_fmu.contact.tooth_contact import loaded_contacts
    from cycloid_fmu.contact.transmission import drive_of
    from cycloid_fmu.wear.progress import contact_coefficients
    from cycloid_fmu.wear.sliding import velocities

    figure, axes = new_figure(4, 3)
    drive = drive_of(model.pair, model.surface, model.unworn.gear.shape[3])
    torque = model.heaviest_torque
    if torque != 0.0:
        contacts = loaded_contacts(drive, model.sweep.crank_angle, torque)
        order = np.argsort(contacts.phase)
        speed = velocities(drive, contacts)
        phase = contacts.phase[order]
        coefficient = contact_coefficients(model.law, drive, contacts)
        mesh: list[tuple[str, list[tuple[str, NDArray[np.float64]]]]] = [
            ("force [N]", [("", contacts.force)]),
            ("pressure [MPa]", [("", contacts.pressure * 1e-6)]),
            ("half width [µm]", [("", contacts.half_width * 1e6)]),
            ("velocity [mm/rad of the ring]",
             [("along pin", speed.pin * 1e3), ("along gear", speed.gear * 1e3), ("sliding", speed.sliding * 1e3)]),
            ("slip coefficient", [("gear", speed.gear_slip), ("pin", speed.pin_slip)]),
            ("k_0 [m²/N]", [("", coefficient)]),
        ]  # fmt: skip
        for axis, (label, curves) in zip(axes, mesh, strict=False):
            for name, values in curves:
                axis.plot(phase, values[order], ".", ms=2, label=name)
            axis.set(xlabel="pin's angle from the crank [rad]", ylabel=label)
            if curves[0][0]:
                show_legend(axis, markerscale=4)
        axes[0].set_title(f"new, {torque:g} N·m", fontsize=9)
        axes[4].set_ylim(-12.0, 12.0)
        axes[4].set_title("the pin's has a pole where the contact turns back", fontsize=9)
    turns = states[-1].crank_turns
    for axis, body, along, label in (
        (axes[6], "gear", np.linspace(0.0, 1.0, model.unworn.gear.shape[2]), "tooth's arc, root to root"),
        (
            axes[7],
            "pin",
            np.linspace(-90.0, 90.0, model.unworn.pin.shape[1]),
            "pin: angle from the circle's centre [°]",
        ),
    ):
        for state in states[1:]:
            depth = getattr(state.depth, body)
            axis.plot(along, depth.reshape(-1, along.size, depth.shape[-1]).max(axis=(0, 2)) * 1e6, lw=0.8, color="C0")
        linear = getattr(new.depth, body) * turns
        shown = linear.reshape(-1, along.size, linear.shape[-1]).max(axis=(0, 2)) * 1e6
        axis.set_ylim(0.0, max(1.3 * getattr(states[-1].depth, body).max() * 1e6, 1e-3))
        axis.plot(along, shown, "k--", lw=1.0, label=f"without update: {shown.max():.3g} µm")
        last = getattr(states[-1].depth, body).reshape(-1, along.size, linear.shape[-1]).max(axis=(0, 2))
        worn = np.flatnonzero(last + shown > 0.0)
        if worn.size:
            margin = 0.1 * (along[worn[-1]] - along[worn[0]])
            axis.set_xlim(along[worn[0]] - margin, along[worn[-1]] + margin)
        axis.set(xlabel=label, ylabel="depth [µm]")
        axis.set_title(f"{body}: each step, deepest of all", fontsize=9)
        show_legend(axis)
    life = figures["life"]
    at = np.array(life["crank_turns"]) * 1e-6
    for body in ("gear", "pin"):
        axes[8].plot(at, np.array(life[f"{body}_depth_max"]) * 1e6, ".-", ms=4, lw=1, label=body)
    axes[8].set(xlabel="million crank turns", ylabel="deepest [µm]")
    show_legend(axes[8])
    for axis, name, label in (
        (axes[9], "transmission_error", "mean TE [arcsec]"),
        (axes[10], "backlash", "mean [arcsec]"),
        (axes[10], "lost_motion", "mean [arcsec]"),
    ):
        axis.plot(at, np.asarray(life[name]) * ARCSEC, ".-", ms=4, lw=1, label=name.replace("_", " "))
        axis.set(xlabel="million crank turns", ylabel=label)
    show_legend(axes[10])
    for name, label in (("transmission_error", "TE"), ("backlash", "backlash"), ("lost_motion", "lost motion")):
        name = f"{name}_range"
        axes[11].plot(at, np.asarray(life[name]) * ARCSEC, ".-", ms=4, lw=1, label=label)
    axes[11].set(xlabel="million crank turns", ylabel="peak to peak [arcsec]")
    show_legend(axes[11])
    return figure
