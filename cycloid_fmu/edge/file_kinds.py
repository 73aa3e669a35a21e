"""Kinds of files: a file given in the place of another is named as what it is, with the command that takes it."""

from __future__ import annotations

import contextlib
import os
import re
import zipfile
from pathlib import Path

from cycloid_fmu.edge.limited import call_limited
from cycloid_fmu.edge.problems import InputError, shown

FORMATS = {
    "cycloid-pair": "a gear pair, for cycloid-fmu analyze, draw, build and --pair",
    "cycloid-reducer": "an RV reducer, for cycloid-fmu budget, analyze and build",
    "cycloid-tolerances": "a tolerance file, for --tolerances",
    "cycloid-requirements": "a requirements file, for --limits",
    "cycloid-design": "a search task, for cycloid-fmu design",
    "cycloid-friction": "a friction file, for --friction",
    "cycloid-joint": "a joint document, the result of cycloid-fmu joint",
    "cycloid-joint-figures": "numbers of a joint, for cycloid-fmu joint --figures",
    "cycloid-wear": "a wear law, for --wear",
    "cycloid-history": "the history of a drive, for cycloid-fit forecast",
    "cycloid-bench": "the wiring of a bench, for cycloid-bench record",
    "cycloid-sequence": "a test sequence, for cycloid-bench run",
    "cycloid-simulation": "a simulated bus with its faults, for cycloid-bench simulate --bus",
    "cycloid-mapping": "a mapping of a bench file, for --mapping",
    "cycloid-instruments": "a list of a bench's instruments, for --instruments",
    "cycloid-certificate": "the content of a certificate, for --certificate",
    "cycloid-read-head": "a read head, for --read-head",
    "cycloid-surface": "an error surface, for --surface",
    "cycloid-recording": "a recording, for cycloid-fit metrics, curve, identify and cycloid-bench export",
    "cycloid-figures": "a file of measured figures, for cycloid-fit compare and --loop",
    "cycloid-identification": "the result of cycloid-fit identify, for --fit",
    "cycloid-recalibration": "the result of cycloid-fit recalibrate, for --after",
    "cycloid-study-checkpoint": "the partial results of a study, which the study's own command resumes",
    "cycloid-analysis": "the result of cycloid-fmu analyze",
    "cycloid-losses": "the result of cycloid-fmu losses",
    "cycloid-sweep": "the result of cycloid-fmu sweep",
    "cycloid-tolerance-study": "the result of cycloid-fmu tolerance",
    "cycloid-influence": "the influence matrix of a body, for [bodies] matrix",
    "cycloid-curve": "the result of cycloid-fit curve",
    "cycloid-friction-fit": "the result of cycloid-fit friction",
    "cycloid-maps": "the result of cycloid-fit maps",
    "cycloid-forecast": "the result of cycloid-fit forecast",
}
"""What a file of each format is, and what takes it."""
_FMU = "an FMU, for cycloid-fmu simulate, inspect and compare"
_TABLE, _LOGGER = "a table (CSV)", "a file of a data logger"
_HDF5, _ZIP, _ARROW = b"\x89HDF\r\n\x1a\n", b"PK\x03\x04", b"\xff\xff\xff\xff"
_BEGINNINGS = {
    b"PAR1": f"{_LOGGER} (Parquet)",
    b"TDSm": f"{_LOGGER} (TDMS)",
    b"MDF ": f"{_LOGGER} (MDF)",
    b"LOGG": f"{_LOGGER} (BLF)",
    b"\x89PNG": "a picture",
    b"%PDF": "a PDF",
}
_STATED = re.compile(rb'^[ \t{]*(?:format|"format")[ \t]*[=:][ \t]*"(cycloid-[\w-]+/\d+)"', re.MULTILINE)
_CONTROL = re.compile(rb"[\x00-\x08\x0e-\x1f]")  # in no header of a table, so such a file is no text
_HEAD = 1 << 16  # bytes from the beginning that are looked at


def kind_of(path: str | os.PathLike[str]) -> str:
    """Return what a file is, from its content, and what takes it; "" if it is none of the known kinds.

    Examples
    --------
    >>> _ = open("t.toml", "w").write('format = "cycloid-wear/1"')
    >>> kind_of("t.toml")
    'a wear law (cycloid-wear/1), for --wear'
    """
    with contextlib.suppress(Exception):  # parsers raise exceptions of any class
        with Path(path).open("rb") as file:
            head = file.read(_HEAD)
        if head.startswith(_HDF5):
            with contextlib.suppress(InputError, RuntimeError):
                return _of_format(call_limited(path, hdf5_format, str(path))) or "a netCDF or HDF5 file"
            return "a netCDF or HDF5 file"
        if head.startswith(_ZIP):
            with zipfile.ZipFile(path) as archive:
                return _FMU if "modelDescription.xml" in archive.namelist() else ""
        if head.startswith(_ARROW):
            return FORMATS["cycloid-recording"] if b"cycloid-recording/" in head else "an Arrow stream"
        if found := _STATED.search(head):
            return _of_format(found[1].decode())
        header = head.partition(b"\n")[0]
        separated = any(mark in header for mark in (b",", b";", b"\t"))
        if b"[" in header and b"=" not in header and separated and not _CONTROL.search(header):
            return _TABLE
        return next((kind for begins, kind in _BEGINNINGS.items() if head.startswith(begins)), "")
    return ""


def hdf5_format(path: str) -> str:
    """Return the format that an HDF5 file states, or ""; to be called by `call_limited`."""
    import h5py

    with h5py.File(path, "r", locking=False) as data:
        stated = data.attrs.get("format", b"")
    return stated.decode() if isinstance(stated, bytes) else str(stated)


def _of_format(stated: str) -> str:
    what, comma, taken_by = FORMATS.get(stated.partition("/")[0], "").partition(",")
    return f"{what} ({stated}){comma}{taken_by}" if what else ""


def wrong_kind(path: str | os.PathLike[str], needed: str, *, tables: bool = False) -> InputError | None:
    """Return the error that a file is of another kind than the needed one; None if its kind is not known.

    Parameters
    ----------
    needed
        What is needed, as words: "a recording".
    tables
        Whether tables and files of data loggers are of the needed kind.
    """
    kind = kind_of(path)
    wrong = kind and not kind.startswith((needed, _TABLE, _LOGGER) if tables else needed)
    return InputError(f"{path}: this is {kind}; {needed} is needed here.") if wrong else None


def check_format(given: object, wanted: str, source: str) -> None:
    """Raise an `InputError` if a file's `format` is not the one that this version reads."""
    if given == wanted:
        return
    if given is None:
        raise InputError(f"{source}: it states no format; {needed(wanted)} is needed here.")
    name, kind = str(given).partition("/")[0], _of_format(str(given))
    if name == wanted.partition("/")[0]:
        raise InputError(f'{source}: format = {shown(given)}: this version reads "{wanted}".')
    if kind:
        raise InputError(f"{source}: this is {kind}; {needed(wanted)} is needed here.")
    raise InputError(f'{source}: format = {shown(given)}: it must be "{wanted}".')


def needed(wanted: str) -> str:
    """Return a format as words, such as "a wear law (cycloid-wear/1)"."""
    kind = FORMATS.get(wanted.partition("/")[0], "a file of the format")
    return f"{kind.partition(',')[0]} ({wanted})"
