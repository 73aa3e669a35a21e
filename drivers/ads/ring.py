"""The ring buffer of samples in a PLC's memory: its layout, and the valid samples in data read from it.

The PLC writes one sample into the ring per cycle (docs/bench.md has its program). Numbers increase by one without end,
so exactly which samples were overwritten before they were read is known. All integers are little-endian and aligned to
their size, so that every pack mode of TwinCAT gives the same bytes:

    ring    UDINT layout = 16#31435943 ("CYC1"), UDINT columns, ULINT length, ULINT started, ULINT newest, samples
    sample  ULINT number, ULINT time, LINT value of each column, ULINT check

`length` is the capacity of the ring in samples: sample n is at place (n - 1) MOD length. `started` is the time of the
first cycle, `newest` the number of the newest sample; times are nanoseconds of the distributed clock. The PLC first
sets `check` to 0, then writes number, time and values, then sets `check` to the number, then `newest`: in a sample read
from low to high addresses while it was written, `number` and `check` differ.
"""

from __future__ import annotations

import dataclasses
import struct

import numpy as np
import numpy.typing as npt

from drivers.recording_format import FloatArray

LAYOUT = int.from_bytes(b"CYC1", "little")
_HEAD = struct.Struct("<IIQQQ")
HEAD_BYTES = _HEAD.size
MOST_COLUMNS, MOST_SAMPLES = 64, 1 << 24
_MOST_NUMBERS = 1 << 62


@dataclasses.dataclass(frozen=True)
class Head:
    """Head of a ring: columns, capacity in samples, time of the first cycle, ns, number of the newest sample."""

    columns: int
    length: int
    started: int
    newest: int

    @property
    def sample_bytes(self) -> int:
        """Size of one sample, bytes."""
        return 24 + 8 * self.columns

    @property
    def ring_bytes(self) -> int:
        """Size of the whole ring, bytes."""
        return HEAD_BYTES + self.length * self.sample_bytes

    def pack(self) -> bytes:
        """Return the head as bytes."""
        return _HEAD.pack(LAYOUT, self.columns, self.length, self.started, self.newest)


def read_head(data: bytes) -> Head:
    """Return the head of a ring, decoded from bytes.

    Raises
    ------
    ValueError
        If they are not the head of a ring; the text gives the reason.
    """
    if len(data) < HEAD_BYTES:
        raise ValueError(f"it has {len(data)} bytes, the head of a ring has {HEAD_BYTES}")
    layout, *rest = _HEAD.unpack(data[:HEAD_BYTES])
    head = Head(*rest)
    if layout != LAYOUT:
        raise ValueError(f"it begins with 16#{layout:08X}, not with a ring's 16#{LAYOUT:08X}")
    if not (1 <= head.columns <= MOST_COLUMNS and 2 <= head.length <= MOST_SAMPLES):
        raise ValueError(
            f"it has {head.columns} columns and {head.length} samples; "
            f"1 to {MOST_COLUMNS} and 2 to {MOST_SAMPLES} are allowed"
        )
    if head.newest > _MOST_NUMBERS:
        raise ValueError(f"its newest sample has the number {head.newest}, which no task can reach")
    return head


def sample_type(columns: int) -> np.dtype[np.void]:
    """Return the memory layout of one sample."""
    return np.dtype([("number", "<u8"), ("time", "<u8"), ("values", "<i8", (columns,)), ("check", "<u8")])


def spans(first: int, last: int, head: Head, most: int) -> list[tuple[int, int]]:
    """Return offsets and sizes, bytes, of the pieces with samples `first` to `last`, of at most `most` bytes each."""
    found = []
    while first <= last:
        place = (first - 1) % head.length
        count = min(last - first + 1, head.length - place, max(1, most // head.sample_bytes))
        found.append((HEAD_BYTES + place * head.sample_bytes, count * head.sample_bytes))
        first += count
    return found


@dataclasses.dataclass(frozen=True)
class Block:
    """Samples in the order of their numbers: arrays of shape (n,), values of shape (n, columns).

    `started` is that of the ring, ns; device times are in s since then, host times in s since 1970.
    """

    started: int
    numbers: npt.NDArray[np.int64]
    time_device: FloatArray
    time_host: FloatArray
    values: npt.NDArray[np.int64]


def whole_samples(data: bytes, first: int, columns: int) -> npt.NDArray[np.void]:
    """Return the complete samples among those read, which have consecutive numbers from `first`.

    The others were overwritten before or while they were read.
    """
    samples = np.frombuffer(data, sample_type(columns))
    due = np.arange(first, first + len(samples), dtype=np.uint64)
    found: npt.NDArray[np.void] = samples[(samples["number"] == due) & (samples["check"] == due)]
    return found
