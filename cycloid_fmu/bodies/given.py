"""Influence matrices in files, `cycloid-influence/1` as netCDF or CSV, from any finite-element program."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from cycloid_fmu import edge
from cycloid_fmu.bodies.mesh import Array
from cycloid_fmu.bodies.ports import KINDS, PortMatrix

FORMAT = "cycloid-influence/1"
_ASYMMETRY, _NEGATIVE = 1e-6, 1e-9  # of the largest entry, and of the largest eigenvalue
_MOST_PORTS = 20_000
_LARGEST = 1e9
_NUMBERS = ("x", "y", "direction_x", "direction_y")


def read_influence(path: str | os.PathLike[str], half_width: float) -> PortMatrix:
    """Return the influence matrix of a body from a file, checked.

    Parameters
    ----------
    path
        netCDF, or CSV (`.csv`): the ports in the first row and column as `kind:index:x:y:dx:dy` in SI, and in the first
        cell gauge and half width of patches as `free:0.0005`; if that is empty, the gauge is "free" and the half width
        as follows.
    half_width
        Half width of patches for a CSV file that does not state it, m.

    Raises
    ------
    edge.InputError
        If it can't be read, a port is wrong, or the matrix is not symmetric and positive semidefinite: asymmetric by
        more than 1e-6 of its largest entry, or with an eigenvalue below -1e-9 of the largest; in a free gauge without
        the part of rigid motions.
    """
    read = _of_csv if Path(path).suffix.lower() == ".csv" else _of_netcdf
    matrix = read(path, half_width)
    _check(matrix, str(path))
    return matrix


def write_influence(matrix: PortMatrix, path: str | os.PathLike[str]) -> None:
    """Write an influence matrix as netCDF; never a partial file."""
    import xarray as xr

    metres = {"units": "m"}
    data: dict[str, Any] = {
        "compliance": (("port", "port2"), matrix.compliance, {"units": "m/N", "long_name": "displacement over force"}),
        "kind": ("port", matrix.kind.astype(object)),
        "index": ("port", matrix.index, {"long_name": "tooth, crank, pin or disc"}),
        "x": ("port", matrix.place.real, metres),
        "y": ("port", matrix.place.imag, metres),
        "direction_x": ("port", matrix.direction.real, {"units": "1"}),
        "direction_y": ("port", matrix.direction.imag, {"units": "1"}),
    }
    about = {"format": FORMAT, "gauge": matrix.gauge, "patch_half_width": matrix.patch_half_width}
    edge.write_netcdf(xr.Dataset(data, attrs=about), path)


def _of_netcdf(path: str | os.PathLike[str], half_width: float) -> PortMatrix:
    file = edge.netcdf(path, FORMAT)
    missing = [name for name in ("compliance", "kind", "index", *_NUMBERS) if name not in file.variables]
    if missing:
        raise edge.InputError(f"{path}: the variable {missing[0]} is missing.")
    missing = [name for name in ("gauge", "patch_half_width") if name not in file.attrs]
    if missing:
        raise edge.InputError(f"{path}: the attribute {missing[0]} is missing.")
    values = {name: variable.values for name, variable in file.variables.items()}
    ports = values["kind"].size
    if any(values[name].shape != (ports,) for name in ("kind", "index", *_NUMBERS)):
        raise edge.InputError(f"{path}: kind, index, {', '.join(_NUMBERS)} must have one value for each port.")
    try:
        numbers = np.array([np.asarray(values[name], dtype=float) for name in ("index", *_NUMBERS)])
        compliance, width = np.asarray(values["compliance"], dtype=float), float(file.attrs["patch_half_width"])
    except (TypeError, ValueError):
        raise edge.InputError(f"{path}: all variables but kind, and patch_half_width, must be numbers.") from None
    about = {"gauge": file.attrs["gauge"], "patch_half_width": width}
    return _matrix(values["kind"], numbers, compliance, about, str(path))


def _of_csv(path: str | os.PathLike[str], half_width: float) -> PortMatrix:
    head, *rows = [row for row in edge.csv_rows(path) if row] or [[]]
    names = [cell.strip() for cell in head[1:]]
    if [row[0].strip() for row in rows] != names or any(len(row) != len(head) for row in rows):
        raise edge.InputError(
            f"{path}: the first row and the first column must have the same ports, and all rows a value."
        )
    if not names or len(names) > _MOST_PORTS:
        raise edge.InputError(f"{path}: it has {len(names)} ports; there must be 1 to {_MOST_PORTS}.")
    parts = [name.split(":") for name in names]
    bad = next((name for name, part in zip(names, parts, strict=True) if len(part) != 6), None)
    if bad is not None:
        raise edge.InputError(f"{path}: {edge.shown(bad)} is not a port; write kind:index:x:y:dx:dy, in SI.")
    gauge, _, stated = head[0].strip().partition(":")
    width = edge.finite(stated, f"{path}: the first cell") if stated else half_width
    numbers = np.array([[edge.finite(part[n], f"{path}: {':'.join(part)}") for part in parts] for n in range(1, 6)])
    cells = [
        [edge.finite(cell.strip(), f"{path}: line {n}") for cell in row[1:]] for n, row in enumerate(rows, start=2)
    ]
    about = {"gauge": gauge or "free", "patch_half_width": width}
    return _matrix(np.array([part[0] for part in parts]), numbers, np.array(cells), about, str(path))


def _matrix(kind: Any, numbers: Array, compliance: Array, about: Mapping[str, Any], source: str) -> PortMatrix:
    """Make a matrix of the columns index, x, y, direction_x and direction_y, and check all but its sign."""
    kind = np.array([str(name) for name in kind.tolist()])
    if (strange := sorted(set(kind) - set(KINDS))) or kind.size == 0:
        raise edge.InputError(
            f"{source}: kind = {edge.shown(strange[0] if strange else '')}: it may be {', '.join(KINDS)}."
        )
    if compliance.shape != (kind.size, kind.size):
        raise edge.InputError(
            f"{source}: the matrix must be square, with a row and a column for each of {kind.size} ports."
        )
    if not (np.abs(compliance) < _LARGEST).all() or not (np.abs(numbers) < _LARGEST).all():
        raise edge.InputError(f"{source}: compliance, places and directions must be finite, and within ±{_LARGEST:g}.")
    index, place, direction = numbers[0], numbers[1] + 1j * numbers[2], numbers[3] + 1j * numbers[4]
    if (index != np.round(index)).any() or (index < 0).any():
        raise edge.InputError(f"{source}: index must be whole numbers from 0.")
    if (np.abs(np.abs(direction) - 1.0) > 1e-6).any():
        raise edge.InputError(f"{source}: direction_x and direction_y must be unit vectors.")
    gauge, width = str(about["gauge"]), float(about["patch_half_width"])
    if gauge not in ("free", "held"):
        raise edge.InputError(f'{source}: gauge = {edge.shown(gauge)}: it may be "free" or "held".')
    if not 0.0 <= width < 1.0 or (width == 0.0 and (kind == "flank").any()):
        raise edge.InputError(f"{source}: patch_half_width = {width:g}: it must be above zero and below 1 m.")
    return PortMatrix(
        kind, index.astype(np.int64), place, direction, compliance, "free" if gauge == "free" else "held", width
    )


def _check(matrix: PortMatrix, source: str) -> None:
    c = matrix.compliance
    largest = float(np.abs(c).max())
    asymmetry = float(np.abs(c - c.T).max())
    if asymmetry > _ASYMMETRY * largest:
        raise edge.InputError(
            f"{source}: the matrix is not symmetric: entries differ by {asymmetry / largest:.2g} of the largest; "
            f"{_ASYMMETRY:g} at most is allowed."
        )
    symmetric = 0.5 * (c + c.T)
    if matrix.gauge == "free":
        turning = (np.conj(matrix.place) * matrix.direction).imag
        rigid = np.column_stack(
            [matrix.direction.real, matrix.direction.imag, turning / (np.abs(turning).max() or 1.0)]
        )
        basis, sizes, _ = np.linalg.svd(rigid, full_matrices=False)
        basis = basis[:, sizes > 1e-9 * sizes[0]]
        symmetric = symmetric - basis @ (basis.T @ symmetric)
        symmetric = symmetric - (symmetric @ basis) @ basis.T
    values = np.linalg.eigvalsh(0.5 * (symmetric + symmetric.T))
    if not values[-1] > 0.0 or values[0] < -_NEGATIVE * values[-1]:
        raise edge.InputError(
            f"{source}: the matrix is not positive: its smallest eigenvalue is {values[0]:.3g} m/N, its largest "
            f"{values[-1]:.3g} m/N; a force would displace a body against itself."
        )
