"""The ring of samples in a PLC's memory: how it is laid out, and which samples a reading of it holds.

The PLC writes a sample into the ring each cycle (docs/bench.md has its program); numbers go up by one for ever, so what
was overwritten before it was read is known to the sample. All integers are little-endian and lie on multiples of their
size, so that every pack mode of TwinCAT gives the same bytes:

    ring    UDINT layout = 16#31435943 ("CYC1"), UDINT columns, ULINT length, ULINT started, ULINT newest, samples
    sample  ULINT number, ULINT time, LINT value of each column, ULINT check

`length` is how many samples the ring holds: sample n lies at place (n - 1) MOD length. `started` is the time of the
first cycle, `newest` the number of the newest sample; times are nanoseconds of the distributed clock. The PLC sets
`check` to 0 first, then number, time and values, then `check` to the number, then `newest`: a reading from low to high
addresses that met the PLC's writing shows two numbers that differ.
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
    """Beginning of a ring: columns and samples that it holds, its first cycle's time in ns, its newest number."""

    columns: int
    length: int
    started: int
    newest: int

    @property
    def sample_bytes(self) -> int:
        """Bytes of one sample."""
        return 24 + 8 * self.columns

    @property
    def ring_bytes(self) -> int:
        """Bytes of the whole ring."""
        return HEAD_BYTES + self.length * self.sample_bytes

    def pack(self) -> bytes:
        """Return the head's bytes."""
        return _HEAD.pack(LAYOUT, self.columns, self.length, self.started, self.newest)


def read_head(data: bytes) -> Head:
    """Return the head that these bytes are.

    Raises
    ------
    ValueError
        If they are none; the text says what was found.
    """
    if len(data) < HEAD_BYTES:
        raise ValueError(f"it has {len(data)} bytes, a ring's head {HEAD_BYTES}")
    layout, *rest = _HEAD.unpack(data[:HEAD_BYTES])
    head = Head(*rest)
    if layout != LAYOUT:
        raise ValueError(f"it begins with 16#{layout:08X}, a ring with 16#{LAYOUT:08X}")
    if not (1 <= head.columns <= MOST_COLUMNS and 2 <= head.length <= MOST_SAMPLES):
        raise ValueError(
            f"it has {head.columns} columns and {head.length} samples; "
            f"1 to {MOST_COLUMNS} and 2 to {MOST_SAMPLES} are allowed"
        )
    if head.newest > _MOST_NUMBERS:
        raise ValueError(f"its newest sample has the number {head.newest}; no task comes that far")
    return head


def sample_type(columns: int) -> np.dtype[np.void]:
    """Return how one sample lies in memory."""
    return np.dtype([("number", "<u8"), ("time", "<u8"), ("values", "<i8", (columns,)), ("check", "<u8")])


def spans(first: int, last: int, head: Head, most: int) -> list[tuple[int, int]]:
    """Return where the samples with the numbers `first` to `last` lie: offsets in bytes and bytes, at most `most`."""
    found = []
    while first <= last:
        place = (first - 1) % head.length
        count = min(last - first + 1, head.length - place, max(1, most // head.sample_bytes))
        found.append((HEAD_BYTES + place * head.sample_bytes, count * head.sample_bytes))
        first += count
    return found


@dataclasses.dataclass(frozen=True)
class Block:
    """Samples in the order of their numbers, arrays of shape (n,) or, the values, (n, columns).

    `started` is the ring's; device times are in s since then, host times in s since 1970.
    """

    started: int
    numbers: npt.NDArray[np.int64]
    time_device: FloatArray
    time_host: FloatArray
    values: npt.NDArray[np.int64]


def whole_samples(data: bytes, first: int, columns: int) -> npt.NDArray[np.void]:
    """Return those samples of a reading that are whole and bear the number that is due, `first` and so on.

    The others were overwritten before or while they were read.
    """
    samples = np.frombuffer(data, sample_type(columns))
    due = np.arange(first, first + len(samples), dtype=np.uint64)
    found: npt.NDArray[np.void] = samples[(samples["number"] == due) & (samples["check"] == due)]
    return found
