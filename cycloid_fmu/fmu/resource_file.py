"""The file of a model's numbers in an FMU's resources, as `resource.c` reads it.

Little endian: magic, version, size of the rest and two sums of its words; the model's variables and numbers; and the
FMU's token.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Iterable, Sized
from typing import NamedTuple

import numpy as np

from cycloid_fmu.fmu import constants
from cycloid_fmu.fmu.variables import Variable

HEAD = struct.Struct("<8sIIQQ")
KINDS = ("real", "integer", "boolean")
CAUSALITIES = ("input", "output", "parameter", "independent", "local")


class Resource(NamedTuple):
    """A kind of file.

    Attributes
    ----------
    prefix
        Of its constants in C.
    file
        Its name in an FMU's resources.
    magic, version
        The first bytes, and the version behind them.
    """

    prefix: str
    file: str
    magic: str
    version: int


DRIVE = Resource("TABLE", "drive.table", "cycltab\n", constants.TABLE_VERSION)
COMPENSATOR = Resource("COMPENSATOR", "compensator.table", "cyccomp\n", constants.COMPENSATOR_VERSION)


def sealed(body: bytes, token: str, resource: Resource) -> bytes:
    """Return a file of a body and the FMU's token (`guid` or `instantiationToken`), with its head."""
    last = _text(token)
    return headed(body + padding(body) + last + padding(last), resource)


def headed(rest: bytes, resource: Resource) -> bytes:
    """Return a file of its content after the head, of a whole number of words."""
    words = np.frombuffer(rest, "<u4").astype(np.uint64)
    sums = int(words.sum()), int(np.cumsum(words).sum())
    return HEAD.pack(resource.magic.encode(), resource.version, len(rest), *sums) + rest


def padding(body: Sized) -> bytes:
    """Return the padding to a multiple of 8 bytes."""
    return bytes(-len(body) % 8)


def variable_bytes(variables: Iterable[Variable], field_of: Callable[[Variable], int]) -> bytes:
    """Return the number of variables, and each with its field in the C model; value references are 0, 1, 2, …."""
    listed = list(variables)
    body = struct.pack("<I", len(listed))
    for v in listed:
        limits = (-math.inf if v.least is None else v.least, math.inf if v.most is None else v.most)
        body += _text(v.name) + struct.pack(
            "<BBBBidddd",
            KINDS.index(v.kind),
            CAUSALITIES.index(v.causality),
            v.baked,
            v.variability == "fixed",
            field_of(v),
            *limits,
            v.start or 0.0,
            v.nominal or 1.0,
        )
    return body


def _text(text: str) -> bytes:
    encoded = text.encode()
    return struct.pack("<H", len(encoded)) + encoded
