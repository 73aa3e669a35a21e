"""netCDF files: read in a process of their own, written so that a full disk raises an `OSError`."""

from __future__ import annotations

import contextlib
import io
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from cycloid_fmu.edge.file_kinds import check_format, needed, wrong_kind
from cycloid_fmu.edge.files import existing, written_whole
from cycloid_fmu.edge.limited import call_limited, limits_of
from cycloid_fmu.edge.problems import InputError, parsed_by_others, shown

if TYPE_CHECKING:
    import h5py
    import numpy.typing as npt
    import xarray as xr


class Variable(NamedTuple):
    """A variable of a netCDF file: names of its dimensions, values and attributes."""

    dims: tuple[str, ...]
    values: npt.NDArray[Any]
    attrs: dict[str, Any]


class Netcdf(NamedTuple):
    """Attributes and variables of a netCDF file."""

    attrs: dict[str, Any]
    variables: dict[str, Variable]


def netcdf(path: str | os.PathLike[str], wanted_format: str) -> Netcdf:
    """Return the content of a netCDF file of the wanted format.

    Raises
    ------
    InputError
        If it can't be read, is not netCDF, or has another format.
    """
    with existing(path).open("rb") as file:
        if file.read(4) != b"\x89HDF" and (refused := wrong_kind(path, needed(wanted_format))) is not None:
            raise refused
    with parsed_by_others(path, "this is not a netCDF file, or it is damaged"):
        data = call_limited(path, parsed_netcdf, str(path), limits_of(path).memory / 2, needs="h5netcdf")
    texts = {"format": data.attrs.get("format"), "pair": data.attrs.get("pair")}
    texts |= {f"the unit of {name}": one.attrs.get("units") for name, one in data.variables.items()}
    for name, text in texts.items():
        if not isinstance(text, str | None):
            raise InputError(f"{path}: {name} is {shown(text)}; it must be text.")
    check_format(texts["format"], wanted_format, str(path))
    return data


def parsed_netcdf(path: str, most_bytes: float) -> Netcdf:
    """Return the content of a netCDF file; to be called by `call_limited`: HDF5's library may crash.

    Raises
    ------
    InputError
        If a variable is packed, its data are in another file, or they take more than `most_bytes`.
    """
    import h5netcdf
    import h5py
    import numpy as np

    with h5py.File(path, "r", locking=False) as stored:  # many network drives have no locks
        _check_contained(path, stored, most_bytes)
        with h5netcdf.File(stored, "r", decode_vlen_strings=True) as file:
            variables = {n: Variable(v.dimensions, v[...], dict(v.attrs)) for n, v in file.variables.items()}
            attributes = dict(file.attrs)
    for name, (_, values, about) in variables.items():
        if packed := {"scale_factor", "add_offset"} & about.keys():
            raise InputError(f"{path}: {name} has a {min(packed)}; write its values themselves.")
        if values.dtype.kind == "f" and "_FillValue" in about:
            values[values == about["_FillValue"]] = np.nan
    return Netcdf(attributes, variables)


def _check_contained(path: str, file: h5py.File, most_bytes: float) -> None:
    """Refuse data in other files, which HDF5's library would open, and implausibly large variables."""
    import h5py

    elsewhere = file.visititems_links(lambda name, link: None if isinstance(link, h5py.HardLink) else name)
    variables = {} if elsewhere else {n: one for n, one in file.items() if isinstance(one, h5py.Dataset)}
    elsewhere = elsewhere or next((n for n, one in variables.items() if one.external or one.is_virtual), None)
    if elsewhere:
        raise InputError(f"{path}: it holds no data of {elsewhere}; data in other files and behind links are not read.")
    if sum((one.size or 0) * one.dtype.itemsize for one in variables.values()) > most_bytes:
        raise InputError(f"{path}: its variables take more than {most_bytes / 1e9:.1f} GB.")


def write_netcdf(
    data: xr.Dataset, path: str | os.PathLike[str], encoding: Mapping[str, Mapping[str, Any]] | None = None
) -> None:
    """Write a dataset as netCDF, never a partial file; `encoding` as in xarray.

    Raises
    ------
    InputError
        If no file can be written there.
    OSError
        If the disk is full; it names the file.
    """
    with written_whole(path) as temporary, hdf5_target(temporary) as target:
        data.to_netcdf(target, engine="h5netcdf", encoding=encoding)


@contextlib.contextmanager
def hdf5_target(path: Path) -> Iterator[_HDF5Target]:
    """Provide a new file for HDF5's library to write to, and raise its first `OSError` at the end."""
    with _HDF5Target(path) as target:
        yield target
        target.check()


class _HDF5Target(io.RawIOBase):
    """A new file that accepts every write, for HDF5's library, which crashes some time after a failed write.

    After the first failure, writes go to memory. Code that writes large data calls `check` in between.
    """

    def __init__(self, path: Path) -> None:
        self._file = path.open("x+b", buffering=0)
        self._held: list[tuple[int, bytes]] = []
        self._problem: OSError | None = None

    def check(self) -> None:
        """Raise the failure of an earlier write; to be called where HDF5's library is not on the stack."""
        if self._problem is not None:
            raise self._problem

    def readable(self) -> bool:
        return True

    def writable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = os.SEEK_SET, /) -> int:
        return self._file.seek(offset, whence)

    def readinto(self, buffer: Any, /) -> int:
        view = memoryview(buffer).cast("B")
        begin = self._file.tell()
        count = self._file.readinto(view) or 0
        for at, data in self._held:
            first, last = max(at, begin), min(at + len(data), begin + len(view))
            if first < last:
                view[first - begin : last - begin] = data[first - at : last - at]
                count = max(count, last - begin)
        return count

    def write(self, data: Any, /) -> int:
        given = bytes(data)
        if self._problem is None:
            begin, rest = self._file.tell(), memoryview(given)
            try:
                while rest:
                    rest = rest[self._file.write(rest) :]
            except OSError as problem:
                self._problem = problem
                self._file.seek(begin)
        if self._problem is not None:
            self._held.append((self._file.tell(), given))
            self._file.seek(len(given), os.SEEK_CUR)
        return len(given)

    def truncate(self, size: int | None = None, /) -> int:
        try:
            return self._file.truncate(size)
        except OSError as problem:
            self._problem = self._problem or problem
            return size or 0

    def close(self) -> None:
        try:
            self._file.close()
        finally:
            super().close()
