"""Results of a sweep as a labelled dataset, `cycloid-analysis/1`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cycloid_fmu.analysis.solver import solve
from cycloid_fmu.analysis.validity import notes
from cycloid_fmu.contact.transmission import Interrupted, Transmission
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.geometry.losses import PARTS
from cycloid_fmu.geometry.pair import Pair
from cycloid_fmu.losses.figures import LossFigures
from cycloid_fmu.supports.transmission import PARTS as COMPLIANCE_PARTS
from cycloid_fmu.supports.transmission import PLAY_LOAD, OnBearings

if TYPE_CHECKING:
    import xarray as xr

FORMAT = "cycloid-analysis/1"
LOSSES_FORMAT = "cycloid-losses/1"
_LABELS = {
    "transmission_error": ("rad", "transmission error at the output"),
    "backlash": ("rad", "backlash: free rotation of the output with the crank locked"),
    "interference": ("m", "interference where no free position exists"),
    "torsional_stiffness": ("N*m/rad", "torsional stiffness at the output"),
    "contact_count": ("1", "pins that carry more than 1 % of the most loaded pin's force"),
    "max_contact_pressure": ("Pa", "largest contact pressure"),
    "pin_force": ("N", "force of each pin"),
    "pin_pressure": ("Pa", "largest contact pressure of each pin"),
    "slice_force": ("N", "contact lines: force of each pin in each slice"),
    "slice_direction": ("rad", "contact lines: direction about the pin's axis, from that to the pin circle's centre"),
    "gear_element_pressure": ("Pa", "largest pressure that each element of the flanks has seen"),
    "pin_element_pressure": ("Pa", "largest pressure that each element of the pins has seen"),
    "slice": ("m", "middle of the slice from mid-width"),
    "profile": ("1", "middle of the element along the tooth's arc, from its first root to its second"),
    "angle": ("rad", "middle of the element about the pin's axis, from the direction to the pin circle's centre"),
    "torque": ("N*m", "torque of the environment on the output"),
    "crank_angle": ("rad", "crank angle"),
}
_OF_BEARINGS = {
    "disc_shift_x": (("disc",), "m", "shift of each disc's centre from its ideal position along x"),
    "disc_shift_y": (("disc",), "m", "shift of each disc's centre from its ideal position along y"),
    "turning_arm_force": (("disc", "crank"), "N", "force of each crank's or the eccentric's bearing in each disc"),
    "crank_bearing_force": (("crank",), "N", "force of each crank's bearings in carrier or housing"),
    "main_bearing_force": ((), "N", "force of the carrier's bearing in the ring"),
    "output_roller_force": (("disc", "roller"), "N", "force of each output roller in each disc's hole"),
    "crank_torque": ((), "N*m", "torque of the environment on the crank"),
}

_OF_LOSSES = {
    "direction": ("1", "direction of the crank, 1 counter-clockwise"),
    "load": ("N*m", "torque on the output against the start"),
    "input_torque": ("N*m", "torque of the environment on the input shaft"),
    "loss": ("J/rad", "loss of each part for each radian of the crank"),
    "efficiency": ("1", "power that leaves over power that enters, of means over the crank angles"),
    "starting_torque": ("N*m", "torque of the input that starts the drive from rest"),
    "back_driving_torque": ("N*m", "torque on the output that turns the drive backwards from rest; NaN: none"),
}


def analyze(
    drive: DriveValue, torque: ArrayLike, crank_angle: ArrayLike, slices: int | None = None, **options: Any
) -> xr.Dataset:
    """Return the labelled dataset of `solve`, with its `options`.

    If interrupted, it has the finished crank angles, and the attribute `complete` is 0.
    """
    complete = True
    try:
        found = solve(drive, torque, crank_angle, slices, **options)
    except Interrupted as interrupted:
        found, complete = interrupted.result, False
    return labelled(drive, found, slices or drive.slices, complete=complete)


def labelled(drive: DriveValue, found: Transmission, slices: int, *, complete: bool = True) -> xr.Dataset:
    """Return results as a dataset (format `cycloid-analysis/1`) that states the drive, its slices and its notes.

    On stated bearings it has the motion of the bodies and the bearings' forces, behind a first stage angle and torque
    of the sun.
    """
    data = dataset_of(drive.pair, found)
    data.attrs.update(drive.provenance, slices=slices, complete=int(complete))
    data.attrs["notes"] = "\n".join(notes(drive, found))
    if drive.pair.temperature is not None:
        data.attrs["temperature"] = str(drive.pair.temperature)
    if drive.pair.supports is None:
        data["torsional_stiffness"].attrs["long_name"] += ", mesh alone, rigid bodies"
    if found.preload is not None:
        label = {"units": "N", "long_name": "largest pin force without a torque"}
        data["preload"] = ("crank_angle", found.preload, label)
    if isinstance(found, OnBearings):
        _add_bearings(data, drive.pair, found)
    if drive.first_stage is not None and found.crank_torque is not None:
        data = _with_sun(data, drive, found)
    return data


def _add_bearings(data: xr.Dataset, pair: Pair, found: OnBearings) -> None:
    """Add motion of the bodies and forces of the bearings."""
    for name, (dimensions, unit, text) in _OF_BEARINGS.items():
        values = getattr(found, name)
        if values.shape[-1] > 0:
            each = ("torque", "crank_angle", *dimensions)
            # Output rollers have one crank.
            one = "crank" in dimensions and pair.supports is not None and pair.supports.kind == "output_rollers"
            data[name] = (each[:-1], values[..., 0]) if one else (each, values)
            data[name].attrs.update(units=unit, long_name=text)
    bodies = ", with elastic bodies" if pair.bodies is not None else " alone"
    data["torsional_stiffness"].attrs["long_name"] += f", contacts and bearings{bodies}"
    if found.compliance.shape[-1] > 0:
        data["compliance"] = (("torque", "crank_angle", "body"), found.compliance)
        data["compliance"].attrs.update(units="rad/(N*m)", long_name="share of each part in the output's compliance")
        data["body"] = ("body", list(COMPLIANCE_PARTS))
    if "backlash" not in data:
        return
    data["backlash"].attrs["long_name"] = f"play at zero torque, extrapolated from {PLAY_LOAD:g} of the rated torque"
    data["interference"].attrs["long_name"] = (
        "overlap of flanks and pins that no rotation frees, the discs where they stand without a torque"
    )


def _with_sun(data: xr.Dataset, drive: DriveValue, found: Transmission) -> xr.Dataset:
    """Return the dataset with angle and torque of the sun of a first stage."""
    first, grid = drive.first_stage, ("torque", "crank_angle")
    assert first is not None
    assert found.crank_torque is not None
    sun = {"units": "rad", "long_name": "angle of the sun"}
    data = data.assign_coords(sun_angle=("crank_angle", -found.crank_angle * drive.ratio / drive.pair.gear_teeth, sun))
    cranks = {"units": "N*m", "long_name": "total torque of the first stage on the cranks"}
    data["crank_torque"] = (grid, found.crank_torque, cranks)
    at_sun = {"units": "N*m", "long_name": "torque of the environment on the sun"}
    data["sun_torque"] = (grid, -first.sun_share * found.crank_torque, at_sun)
    data["crank_angle"].attrs["long_name"] = "crank angle of ideal gears at the sun's angle"
    for name in ("transmission_error", "backlash", "torsional_stiffness"):
        data[name].attrs["long_name"] += ", sun locked"
    data.attrs["first_stage"] = first.text
    return data


def dataset_of(pair: Pair, result: Transmission) -> xr.Dataset:
    """Return results as a labelled dataset with units."""
    import xarray as xr

    g = pair
    grid = ("torque", "crank_angle")
    pins = (*grid, "disc", "pin")
    each = np.ones((result.torque.size, 1))
    data: dict[str, Any] = {
        "transmission_error": (grid, result.transmission_error),
        "backlash": (grid, each * result.backlash),
        "interference": (grid, each * result.interference),
        "torsional_stiffness": (grid, result.torsional_stiffness),
        "contact_count": (grid, result.contact_count),
        "max_contact_pressure": (grid, result.max_contact_pressure),
        "pin_force": (pins, result.pin_force),
        "pin_pressure": (pins, result.pin_pressure),
    }
    coordinates: dict[str, Any] = {
        "torque": result.torque,
        "crank_angle": result.crank_angle,
        "disc": np.arange(g.discs),
        "pin": np.arange(g.pins),
    }
    if result.slice_force.size:
        slices = result.slice_force.shape[-1]
        profile, around = result.gear_element_pressure.shape[3], result.pin_element_pressure.shape[2]
        data["slice_force"] = ((*pins, "slice"), result.slice_force)
        data["slice_direction"] = ((*pins, "slice"), result.slice_direction)
        data["gear_element_pressure"] = (("torque", "disc", "tooth", "profile", "slice"), result.gear_element_pressure)
        data["pin_element_pressure"] = (("torque", "pin", "angle", "slice"), result.pin_element_pressure)
        coordinates["slice"] = g.face_width * ((np.arange(slices) + 0.5) / slices - 0.5)
        coordinates["tooth"] = np.arange(g.gear_teeth)
        coordinates["profile"] = (np.arange(profile) + 0.5) / profile
        coordinates["angle"] = np.pi * ((np.arange(around) + 0.5) / around - 0.5)
    dataset = xr.Dataset(data, coordinates)
    for name, (unit, text) in _LABELS.items():
        if name in dataset.variables:
            dataset[name].attrs.update(units=unit, long_name=text)
    dataset.attrs["format"] = FORMAT
    return dataset


def labelled_losses(drive: DriveValue, found: LossFigures) -> xr.Dataset:
    """Return a drive's losses as a dataset (format `cycloid-losses/1`), with the variables of an analysis.

    They are over `torque`, `direction` (of the crank, 1 and -1) and `crank_angle`.
    """
    import xarray as xr

    directions = []
    for sweep in found.sweeps.values():
        data = dataset_of(drive.pair, sweep.motion).drop_vars(["backlash", "interference"])
        _add_bearings(data, drive.pair, sweep.motion)
        data["input_torque"] = (("torque", "crank_angle"), sweep.input_torque)
        data["loss"] = (("torque", "crank_angle", "part"), sweep.loss)
        directions.append(data)
    direction = xr.DataArray(list(found.sweeps), dims="direction", name="direction")
    data = xr.concat(directions, direction, data_vars="all").transpose("torque", "direction", "crank_angle", ...)
    data = data.assign_coords(part=list(PARTS), load=list(found.starting))
    efficiency = [case.efficiency for case in found.cases]
    data["efficiency"] = (("torque", "direction"), np.reshape(efficiency, (-1, len(found.sweeps))))
    data["starting_torque"] = (("load", "crank_angle"), list(found.starting.values()))
    data["back_driving_torque"] = ("crank_angle", found.back_driving)
    for name, (unit, text) in _OF_LOSSES.items():
        data[name].attrs.update(units=unit, long_name=text)
    data.attrs.update(drive.provenance, format=LOSSES_FORMAT, crank_speed=found.crank_speed)
    if drive.first_stage is not None:
        data.attrs["first_stage"] = drive.first_stage.text
    return data


def statistics(data: Mapping[Any, Any]) -> dict[str, NDArray[np.float64]]:
    """Return the error-surface paper's figures of an analysis (dataset or arrays by name), one value for each torque.

    MTE and PPTE are the mean and peak-to-peak transmission error, MB and PPB those of the backlash (rad; NaN where
    there is no free position), MCS the largest contact pressure (Pa).
    """
    error, backlash = np.asarray(data["transmission_error"]), np.asarray(data["backlash"])
    return {
        "MTE": error.mean(axis=1),
        "PPTE": np.ptp(error, axis=1),
        "MB": backlash.mean(axis=1),
        "PPB": np.ptp(backlash, axis=1),
        "MCS": np.asarray(data["max_contact_pressure"]).max(axis=1),
    }
