"""Plots of the results of this package; every function returns a matplotlib figure."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu.draw.figure import at_least, new_figure, show_legend
from cycloid_fmu.draw.figure import save as save  # re-exported for the commands
from cycloid_fmu.edge import ARCMIN, ARCSEC

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from cycloid_fmu.geometry.pair import Pair
    from cycloid_fmu.supports.figures import Share


def plot(result: object, path: str | os.PathLike[str] | None = None) -> Figure:
    """Draw a result, and write the picture if a path is given.

    Parameters
    ----------
    result
        Result of `Drive.analyze`, `losses`, `motion`, `study`, `sweep`, `wear`, `profile` or `budget`, a drive or an
        error surface.
    path
        `.png` or `.pdf`; for a motion also `.svg`, or `.html` for an animated page.

    Raises
    ------
    TypeError
        If the result has another type.
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
    from cycloid_fmu.draw.drive_page import write_motion
    from cycloid_fmu.draw.drive_picture import plot_motion
    from cycloid_fmu.motion import Motion

    if isinstance(result, Motion):
        if path is not None:
            write_motion(result, path)
        return plot_motion(result)
    figure = _figure_of(result)
    if path is not None:
        save(figure, path)
    return figure


def _figure_of(result: Any) -> Figure:
    """Return the figure of a result that is no motion."""
    import xarray as xr

    from cycloid_fmu.cad.profile import Profile
    from cycloid_fmu.draw import losses, profiles, sweeps, wear_plots
    from cycloid_fmu.losses.figures import LossFigures
    from cycloid_fmu.losses.heat import Heat
    from cycloid_fmu.studies.sweep import FORMAT as SWEEP
    from cycloid_fmu.studies.yields import Findings
    from cycloid_fmu.surfaces.surface import ErrorSurface
    from cycloid_fmu.wear.life import WearRun

    match result:
        case xr.Dataset():
            return sweeps.plot_sweep(result) if result.attrs.get("format") == SWEEP else plot_analysis(result)
        case Profile():
            return profiles.plot_profile(result)
        case Findings():
            return plot_tolerance(result.result)
        case LossFigures():
            return losses.plot_losses(result)
        case Heat():
            return losses.plot_heat([result])
        case WearRun():
            return wear_plots.plot_wear(result.model, result.states, result.new, result.figures)
        case ErrorSurface() | object(surface=ErrorSurface()):
            return plot_surface(getattr(result, "surface", result))
        case {"standard": _}:
            return plot_budget(result)
    raise TypeError(f"result is a {type(result).__name__}: it can't be drawn")


def plot_bearings(data: xr.Dataset, pair: Pair, shares: Sequence[Share]) -> Figure:
    """Forces of the bearings and shifts of the discs over the crank, and shares of compliance and lost motion."""
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
    largest = max(float(values.max()) for _, values, _ in panels)
    for axis, values, name in panels:
        for number, force in enumerate(values.T):
            each = f"disc {number // cranks}" + (f", crank {number % cranks}" if cranks > 1 else "")
            which = each if axis is axes[0] else f"crank {number}"
            axis.plot(angle, force, lw=1.0, label=which if values.shape[1] > 1 else None)
        at_least(axis, _FORCES * largest)
        if 1 < values.shape[1] <= 9:
            show_legend(axis, ncols=3, fontsize=7, loc="upper center")
            axis.set_ylim(top=axis.get_ylim()[1] * (1.3 if values.shape[1] > 3 else 1.15))  # space for the legend
        axis.set(xlabel="crank angle [°]", ylabel="force [N]", title=f"{name}, {float(first['torque']):g} N·m")
        axis.title.set_fontsize(9)
    for disc in data["disc"].values:
        one = first.sel(disc=disc)
        axes[3].plot(one["disc_shift_x"] * 1e6, one["disc_shift_y"] * 1e6, lw=1.0, label=f"disc {disc}")
    axes[3].set(xlabel="x [µm]", ylabel="y [µm]")
    axes[3].set_title(f"shift of each disc's centre, {float(first['torque']):g} N·m", fontsize=9)
    at_least(axes[3], _SHIFT)
    axes[3].set_aspect("equal", "datalim")
    show_legend(axes[3])
    soft = {share.part: share.compliance * 1e6 for share in shares}
    left = math.nan if pair.supports is None else remaining(pair.supports, shares)
    if soft and not math.isnan(left):
        soft["rest, up to catalogue"] = left * 1e6
    lost = {share.part: share.lost_motion * ARCMIN for share in shares}
    for axis, lengths, label in ((axes[4], soft, "compliance [µrad/(N·m)]"), (axes[5], lost, "lost motion [arcmin]")):
        axis.barh(list(lengths), list(lengths.values()), color="#4c78a8")
        axis.invert_yaxis()
        axis.set(xlabel=label)
        at = ", at 20 °C" if "temperature" in data.attrs else ""
        axis.set_title(f"{label.split(' [')[0]} as drawn, part by part{at}", fontsize=9)
        if not lengths:
            axis.text(0.5, 0.5, "needs a rated torque", ha="center", transform=axis.transAxes)
    figure.suptitle(title_of(data), fontsize=11)
    return figure


_ZOOMED = 3  # pin pitches
# Spans that axes have at least: the accuracy of angles, arcsec; shares of a force, and of what never comes near zero.
_ANGLE, _FORCES, _SHARE, _SHIFT = 0.01, 0.01, 0.01, 0.02  # the last one in µm
_ALIKE = "one pin pitch (all equal)"


def title_of(data: xr.Dataset) -> str:
    """Name the drive of an analysis, its loads and temperatures."""
    pins, discs = data.sizes["pin"], data.sizes["disc"]
    said = f"Cycloid drive {pins - 1}/{pins}" + (f", {discs} discs" if discs > 1 else "")
    said += f", {', '.join(f'{load:g}' for load in data['torque'].values)} N·m on the output"
    said += ", sun locked" if "first_stage" in data.attrs else ""
    return said + (f"\n{data.attrs['temperature']}" if "temperature" in data.attrs else "")


def _repeats(data: xr.Dataset, name: str) -> bool:
    """Whether a figure repeats in each pin pitch, so that one pitch shows everything."""
    angle, pitch = data["crank_angle"].values, 2.0 * math.pi / data.sizes["pin"]
    if angle.size < 100 or angle[-1] - angle[0] < 2 * _ZOOMED * pitch:
        return False
    # Neighbours in one folded pitch are from pitches far apart: if these differ, the folded curve is jagged.
    folded = data[name].values[:, np.argsort(angle % pitch)]
    return bool((np.abs(np.diff(folded)).sum(axis=1) <= 10.0 * np.ptp(folded, axis=1)).all())


def plot_analysis(data: xr.Dataset) -> Figure:
    """Transmission error about its mean, backlash, contacts, pressure and stiffness over the crank, load of each pin.

    Figures that repeat in each pin pitch are drawn over one pitch, with the points of all; others over all crank
    angles.
    """
    figure, axes = new_figure(4, 2)
    _draw_transmission_error(axes[:2], data)
    figure.legend(
        *axes[0].get_legend_handles_labels(),
        title=title_of(data),
        title_fontsize=11,
        loc="outside upper center",
        ncols=2,
        fontsize=8,
        frameon=False,
    )
    if _repeats(data, "transmission_error"):
        figure.delaxes(axes[0])
        axes[1].set_subplotspec(axes[1].get_subplotspec().get_gridspec()[0, :])
    alone = " of contacts and bearings alone" if "turning_arm_force" in data else " of the mesh alone"
    panels: tuple[tuple[str, str, str, float], ...] = (
        ("backlash", "backlash", "[arcsec]", ARCSEC),
        ("max_contact_pressure", "largest contact pressure", "[MPa]", 1e-6),
        ("contact_count", "pins in contact", "pins", 1.0),
        ("torsional_stiffness", f"torsional stiffness{alone}", "[N·m/arcmin]", 1.0 / ARCMIN),
    )
    for axis, (name, label, unit, factor) in zip(axes[2:6], panels, strict=True):
        _draw_over_crank(axis, data, name, label, factor)
        axis.set_ylabel(unit)
    figure.delaxes(axes[7])
    axes[6].set_subplotspec(axes[6].get_subplotspec().get_gridspec()[3, :])
    _draw_pin_forces(axes[6], data)
    return figure


def _folded(data: xr.Dataset) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
    """Crank angles folded to one pin pitch, °, and their ascending order, both of shape (crank_angle,)."""
    angle = np.degrees(data["crank_angle"].values) % (360.0 / data.sizes["pin"])
    return angle, np.argsort(angle)


def _draw_transmission_error(axes: NDArray[np.object_], data: xr.Dataset) -> None:
    """Draw the transmission error over all crank angles, and over one pitch, or the first few if it does not repeat."""
    angle = np.degrees(data["crank_angle"].values)
    repeated = _repeats(data, "transmission_error")
    if repeated:
        place, near = _folded(data)
    else:
        pitch = 360.0 / data.sizes["pin"]
        place, near = angle, np.flatnonzero(angle <= angle[0] + _ZOOMED * pitch + 1e-9)
    for axis, shown, at, style in (
        (axes[0], np.arange(angle.size), angle, "-"),
        (axes[1], near, place, "-" if repeated else ".-"),  # few points of a pitch are seen as such
    ):
        for torque in data["torque"].values:
            error = data["transmission_error"].sel(torque=torque).values * ARCSEC
            label = f"{torque:g} N·m: mean {error.mean():.2f}″, peak to peak {np.ptp(error):.2f}″"
            axis.plot(at[shown], error[shown] - error.mean(), style, ms=3, lw=1.0, label=label)
        at_least(axis, _ANGLE)
        axis.set(xlabel="crank angle [°]", ylabel="TE - mean [arcsec]")
    axes[0].set_title("transmission error (TE) about its mean", fontsize=9)
    zoom = f"transmission error (TE) about its mean, {_ALIKE}" if repeated else f"the first {_ZOOMED} pin pitches"
    axes[1].set_title(zoom, fontsize=9)


def _draw_over_crank(axis: Axes, data: xr.Dataset, name: str, label: str, factor: float) -> None:
    """Draw a figure, times `factor`, over the crank angle, or over one pitch if it repeats; backlash at one torque."""
    from matplotlib.ticker import MaxNLocator

    repeated = _repeats(data, name)
    angle, order = _folded(data) if repeated else (np.degrees(data["crank_angle"].values), slice(None))
    for torque in data["torque"].values[: 1 if name == "backlash" else None]:
        values = data[name].sel(torque=torque).values * factor
        style = "steps-mid" if name == "contact_count" else "default"
        axis.plot(angle[order], values[order], lw=1.0, drawstyle=style)
    largest = float(np.nan_to_num(np.abs(data[name].values)).max(initial=0.0)) * factor
    at_least(axis, _ANGLE if name == "backlash" else _SHARE * largest)
    axis.set_xlabel("crank angle [°]")
    axis.set_title(label + (f", {_ALIKE}" if repeated else ""), fontsize=9)
    if name == "contact_count":
        axis.yaxis.set_major_locator(MaxNLocator(integer=True))
        axis.margins(y=0.15)
    if np.isnan(data[name].values).all():
        axis.text(0.5, 0.5, "no free position (interference)", ha="center", transform=axis.transAxes)


def _draw_pin_forces(axis: Axes, data: xr.Dataset) -> None:
    """Draw the force of each pin of the first disc over the crank angle, at the first torque."""
    forces, angle = data["pin_force"].isel(torque=0, disc=0), np.degrees(data["crank_angle"].values)
    image = axis.pcolormesh(angle, data["pin"].values, forces.values.T, cmap="viridis", shading="nearest")
    of_disc = ", disc 0" if data.sizes["disc"] > 1 else ""
    axis.set(xlabel="crank angle [°]", ylabel="pin")
    axis.set_title(f"force of each pin, {data['torque'].values[0]:g} N·m{of_disc}", fontsize=9)
    axis.grid(visible=False)
    axis.figure.colorbar(image, ax=axis, label="N")


def plot_lines(data: xr.Dataset) -> Figure:
    """Contact lines at one crank angle, the load around the pin circle, and the largest pressure of each element."""
    from matplotlib.ticker import MaxNLocator

    figure, axes = new_figure(2, 2)
    torque = float(data["torque"].values[0])
    one = data.isel(torque=0, disc=0)
    forces = one["pin_force"].max("crank_angle").values
    figure.delaxes(axes[0])
    polar: Any = figure.add_subplot(2, 2, 1, projection="polar")
    around = 2.0 * np.pi * data["pin"].values / data.sizes["pin"]
    polar.bar(around, one["pin_force"].isel(crank_angle=0).values, width=0.9 * around[1])
    polar.plot(np.append(around, around[0]), np.append(forces, forces[0]), "k.", ms=3)
    polar.set_rlabel_position(135.0)
    polar.yaxis.set_major_locator(MaxNLocator(3))
    polar.tick_params(labelsize=7)
    polar.set_title(f"force of each pin at the first crank angle, N\n(dots: largest), {torque:g} N·m", fontsize=9)
    z = data["slice"].values * 1e3
    line = one["slice_force"].isel(crank_angle=0)
    for pin in np.argsort(-line.sum("slice").values)[:5]:
        width = z[1] - z[0] if z.size > 1 else 1.0
        axes[1].step(z, line.values[pin] / width, where="mid", label=f"pin {pin}")
    axes[1].set(xlabel="across the face [mm]", ylabel="line load [N/mm]")
    axes[1].set_title(f"contact lines at the first crank angle, {torque:g} N·m", fontsize=9)
    show_legend(axes[1], loc="center left", bbox_to_anchor=(1.0, 0.5))
    flank = one["gear_element_pressure"].max("tooth").values * 1e-6
    pins = data["pin_element_pressure"].isel(torque=0).max("pin").values * 1e-6
    edges = [z.min() - 1e-9, z.max() + 1e-9]
    for axis, image, extent, label in (
        (axes[2], flank, [*edges, 0.0, 1.0], "tooth: fraction of the arc"),
        (axes[3], pins, [*edges, -90.0, 90.0], "pin: angle from the centre [°]"),
    ):
        loaded = np.flatnonzero(image.max(axis=1) > 0.0)
        shown = axis.imshow(image, extent=extent, origin="lower", aspect="auto", cmap="magma", interpolation="nearest")
        axis.set(xlabel="across the face [mm]", ylabel=label)
        if loaded.size:  # nothing to show without contact
            span = (extent[3] - extent[2]) / image.shape[0]
            low, high = (extent[2] + span * (edge + side) for edge, side in ((loaded[0], 0.0), (loaded[-1], 1.0)))
            axis.set_ylim(max(low - 0.2 * (high - low), extent[2]), min(high + 0.2 * (high - low), extent[3]))
        axis.grid(visible=False)
        figure.colorbar(shown, ax=axis, label="largest pressure [MPa]")
    axes[2].set_title(f"flanks, over all teeth and crank angles, {torque:g} N·m", fontsize=9)
    axes[3].set_title(f"pins, over all pins and crank angles, {torque:g} N·m", fontsize=9)
    figure.suptitle(title_of(data), fontsize=11)
    return figure


def plot_surface(surface: object) -> Figure:
    """Position and radius errors of the pins, cumulative pitch of the teeth, and the elements' deviations if any.

    Deviations are drawn as the mean of all teeth, for tooth 0 of disc 0, as the mean of all pins and for pin 0.
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
            elements.T * 1e6,
            origin="lower",
            aspect="auto",
            extent=(*ends, -0.5, 0.5),
            cmap="RdBu_r",
            vmin=-largest,
            vmax=largest,
        )
        axis.set(xlabel=label, ylabel="fraction of the width")
        axis.set_title(f"deviation, {title}", fontsize=9)
        axis.grid(False)
        figure.colorbar(image, ax=axis, label="µm")
    pair = surface.pair
    origin = "" if surface.origin == "nominal" else f", {surface.origin}"
    figure.suptitle(f"Errors of a cycloid drive {pair.gear_teeth}/{pair.pins}{origin}", fontsize=11)
    return figure


def plot_budget(found: Mapping[str, Mapping[str, float]], stack: object = None) -> Figure:
    """Terms of a lost motion budget by size, by closed form and contact model; distribution of the total below.

    `stack` is a `reducer.Stack` or None.
    """
    from cycloid_fmu.reducer.lost_motion import TERMS
    from cycloid_fmu.reducer.stack import Stack

    closed, exact = found["standard"], found["geometric_sun_locked"]
    names = sorted(TERMS, key=lambda n: -abs(closed[n]))
    names = [n for n in names if closed[n] != 0.0 or exact[n] != 0.0]
    figure, axes = new_figure(1 if stack is None else 2)
    figure.set_figheight(4.6 if stack is None else 8.0)
    axis = axes[0]
    place = np.arange(len(names))
    for shift, terms, label in ((-0.2, closed, "closed form"), (0.2, exact, "contact model, sun locked")):
        axis.bar(
            place + shift,
            [terms[n] * ARCMIN for n in names],
            0.38,
            label=f"{label}: {terms['total'] * ARCMIN:.3f}′ in total",
        )
    axis.axhline(0.0, color="k", lw=0.8)
    axis.set(ylabel="play at the output [arcmin]")
    axis.set_title("lost motion, term by term; a term below zero reduces the play", fontsize=9)
    axis.set_xticks(place, [n.replace("_", "\n") for n in names], fontsize=7)
    axis.grid(alpha=0.3, axis="y")
    show_legend(axis, loc="lower right")
    if stack is not None:
        assert isinstance(stack, Stack)
        axis = axes[1]
        for name, label in (("standard", "closed form"), ("geometric", "contact model, sun locked")):
            axis.hist(stack.samples[name] * ARCMIN, bins=40, alpha=0.5, density=True, label=label)
        for span, label, height in (
            (stack.worst_case, "worst case", 0.9),
            (stack.root_sum_square, "root sum square", 0.95),
        ):
            axis.plot([v * ARCMIN for v in span], [height] * 2, "|-", transform=axis.get_xaxis_transform(), label=label)
        axis.set(xlabel="total play [arcmin]", ylabel="density", ylim=(0.0, 1.2 * axis.get_ylim()[1]))
        show_legend(axis, ncols=4, loc="lower left", bbox_to_anchor=(0.0, 1.0))
    return figure


# SI unit of a tolerance study's figures: (unit shown, its factor)
SHOWN = {"rad": ("arcsec", ARCSEC), "Pa": ("MPa", 1e-6), "m": ("µm", 1e6), "N*m": ("N·m", 1.0), "1": ("%", 100.0)}


def plot_tolerance(result: object) -> Figure:
    """Distribution of every figure of a tolerance study, with its limit and the share of drives that meet it.

    Figures without a limit that are the same in all drives are not drawn; with a limit they are one bar.
    """
    from matplotlib.ticker import MaxNLocator

    from cycloid_fmu.studies.tolerance import FIGURES, PER_TORQUE, Result, yields

    assert isinstance(result, Result)
    study = result.study
    limits, kept = study.tolerances.limits.stated(), yields(result)
    every = list(dict.fromkeys(n for n, _ in study.columns))
    names = [n for n in every if n in limits or _varies(result.figure(n))] or every
    figure, axes = new_figure((len(names) + 1) // 2, 2)
    for axis in axes[len(names) :]:
        figure.delaxes(axis)
    for axis, name in zip(axes, names, strict=False):
        unit, factor = SHOWN[FIGURES[name][0]]
        values = result.figure(name)[result.independent] * factor
        infinite = int(np.isinf(values).sum())
        values = values[np.isfinite(values)] if infinite else values
        signed = name == "mean_transmission_error"  # both directions together would have a gap between them
        for k, column in enumerate(values.reshape(len(values), -1).T):
            label = f"{study.torque[k]:g} N·m" if name in PER_TORQUE else None
            column = column * np.sign(study.torque[k] or 1.0) if signed else column
            if not column.size:
                axis.text(0.5, 0.5, "none in any drive", transform=axis.transAxes, ha="center")
            elif _varies(column):
                axis.hist(column, bins="auto", histtype="stepfilled", alpha=0.5, color=f"C{k}", label=label)
            else:
                alike = f"{label or 'all drives'}: {column[0]:.4g} in each"
                axis.vlines(column[0], 0.0, column.size, f"C{k}", lw=3.0, label=alike)
        said = ", along the load" if signed else f", none in {infinite} drives" if infinite else ""
        axis.set(xlabel=f"{name.replace('_', ' ')}{said} [{unit}]", ylabel="drives")
        axis.yaxis.set_major_locator(MaxNLocator(integer=True))
        if name in limits:
            _show_limit(
                axis, limits[name] * factor, f"limit {limits[name] * factor:g}: {kept[name]['share']:.1%} meet it"
            )
        if axis.get_legend_handles_labels()[0]:
            show_legend(axis, loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=3)
    teeth, drives = study.pair.gear_teeth, result.figure(names[0])[result.independent].shape[0]
    figure.suptitle(f"Cycloid drive {teeth}/{teeth + 1}: {drives} drives within tolerances", fontsize=11)
    return figure


def _varies(values: NDArray[np.float64]) -> bool:
    """Whether the drives of a study differ by more than rounding."""
    return bool(np.isinf(values).any() or np.ptp(values) > 1e-6 * np.abs(values).max())


def _show_limit(axis: Axes, limit: float, label: str) -> None:
    """Show a limit as a line, or as an arrow if it is so far from all drives that these would be squeezed."""
    low, high = axis.get_xlim()
    if low - 0.5 * (high - low) <= limit <= high + 0.5 * (high - low):
        axis.axvline(limit, color="k", ls="--", lw=1, label=label)
        return
    beyond = limit > high
    axis.plot([], [], "k", marker="$\\rightarrow$" if beyond else "$\\leftarrow$", ls="", ms=9, label=label)
    end, start = (0.995, 0.9) if beyond else (0.005, 0.1)
    arrow = {"arrowstyle": "->", "lw": 1.2}
    axis.annotate("", (end, 0.9), (start, 0.9), xycoords="axes fraction", textcoords="axes fraction", arrowprops=arrow)


def plot_indices(factors: Sequence[str], indices: Mapping[str, Mapping[str, NDArray[np.float64]]]) -> Figure:
    """First-order and total Sobol indices of each tolerance for each figure, with their 95 % intervals."""
    figure, axes = new_figure((len(indices) + 1) // 2, 2)
    for axis in axes[len(indices) :]:
        figure.delaxes(axis)
    place = np.arange(len(factors))
    for axis, (name, found) in zip(axes, indices.items(), strict=False):
        for shift, kind in ((-0.2, "first_order"), (0.2, "total")):
            axis.bar(
                place + shift,
                found[kind],
                0.38,
                yerr=found[f"{kind}_confidence"],
                capsize=2,
                error_kw={"lw": 0.8},
                label=kind.replace("_", " "),
            )
        axis.set_xticks(place, [f.replace("_", " ") for f in factors], rotation=60, ha="right", fontsize=7)
        axis.set(ylabel="Sobol index")
        axis.set_title(name.replace("_", " "), fontsize=9)
    show_legend(axes[0])
    figure.set_size_inches(figure.get_figwidth(), 1.4 * figure.get_figheight())
    return figure


def plot_allocation(factors: Sequence[str], scale: NDArray[np.float64], title: str) -> Figure:
    """Width of each allocated tolerance relative to the stated one: narrower left of the line, wider right of it."""
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


def plot_simulation(results: Mapping[str, NDArray[np.float64]], title: str) -> Figure:
    """Transmission error, backlash and largest pressure of an FMU's run over time; `title` names FMU and load."""
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
        values = results[name] * factor
        axis.plot(time, values, lw=1.2)
        at_least(axis, _SHARE * float(np.abs(values).max()) if name == "max_contact_pressure" else _ANGLE)
        axis.set(ylabel=label)
    axes[-1].set(xlabel="time [s]")
    figure.suptitle(title, fontsize=11)
    return figure


_ROUNDING = 1e-9  # of the larger variable: differences below are rounding
# Units in which differences of an FMU's variables are shown.
DIFFERENCE_UNITS = {
    "flange_a.phi": ("arcsec", ARCSEC),
    "flange_b.phi": ("arcsec", ARCSEC),
    "transmission_error": ("arcsec", ARCSEC),
    "backlash": ("arcsec", ARCSEC),
    "flange_a.w": ("rad/s", 1.0),
    "flange_b.w": ("rad/s", 1.0),
    "flange_a.tau": ("N·m", 1.0),
    "flange_b.tau": ("N·m", 1.0),
    "torsional_stiffness": ("N·m/arcmin", 1.0 / ARCMIN),
    "max_contact_pressure": ("MPa", 1e-6),
    "power_loss": ("W", 1.0),
    "elastic_energy": ("J", 1.0),
    "dissipated_energy": ("J", 1.0),
}


def plot_comparison(
    time: NDArray[np.float64],
    pairs: Mapping[str, tuple[NDArray[np.float64], NDArray[np.float64]]],
    one: str,
    other: str,
) -> Figure:
    """Difference over time of each variable that two FMUs, or an FMU and a recording, have in common."""
    equal = [name for name, (first, second) in pairs.items() if np.array_equal(first, second)]
    pairs = {name: both for name, both in pairs.items() if name not in equal} or pairs
    figure, axes = new_figure((len(pairs) + 1) // 2, 2, sharex=True)
    for axis, (name, (first, second)) in zip(axes, pairs.items(), strict=False):
        unit, factor = DIFFERENCE_UNITS.get(name, ("", 1.0))
        axis.plot(time, (first - second) * factor, lw=1.0)
        at_least(axis, _ROUNDING * factor * float(max(np.abs(first).max(), np.abs(second).max())))
        axis.set(ylabel=f"{name} [{unit}]")
    for axis in axes[len(pairs) :]:
        axis.set_axis_off()
    for axis in axes[-2:]:
        axis.set(xlabel="time [s]")
    figure.suptitle(f"{one} minus {other}" + (f"\nno difference: {', '.join(equal)}" if equal else ""), fontsize=11)
    return figure
