"""Scripted faults of the simulated bench: kind, time and target."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Annotated, Literal, TypeAlias

import pydantic
import pydantic.dataclasses

from cycloid_fmu import edge

Kind: TypeAlias = Literal[
    "drop",
    "duplicate",
    "swap",
    "short",
    "garbage",
    "clock_jump",
    "reset",
    "emergency",
    "reboot",
    "silence",
    "bus_off",
    "mute",
    "half",
    "corrupt",
    "wrong_baud",
    "pull",
]
_FRAME_FAULTS = ("drop", "duplicate", "swap", "short", "garbage")
NODE_FAULTS = ("emergency", "reboot", "silence", "bus_off")
SERIAL_FAULTS = ("mute", "half", "corrupt", "garbage", "wrong_baud", "pull")


@pydantic.dataclasses.dataclass(frozen=True, config=pydantic.ConfigDict(extra="forbid"))
class Fault:
    """One fault.

    Attributes
    ----------
    kind
        Of a CAN frame: "drop" not sent, "duplicate" sent twice, "swap" sent after the next frame, "short" last byte
        missing, "garbage" replaced by random bytes of another length, "clock_jump" stamps jump by `by` from here on
        (virtual bus), "reset" the counter restarts at 0. Of a node: "emergency" sends an EMCY, "reboot" restarts,
        "silence" sends neither frames nor heartbeat. Of the bus: "bus_off". On a serial line: "mute" no answer, "half"
        half an answer, "corrupt" a flipped bit, "garbage" random bytes, "wrong_baud" an answer received at three
        quarters of the baud rate, "pull" cable unplugged.
    sample
        First sample (CAN), or first request or line (serial), counted from 0.
    count
        Duration in samples, requests or lines.
    target
        Identifier of the frame (0x181, 0x182, 0x2A0, SYNC 0x80), whose low bits are the node, or address of the serial
        encoder; 0 if there is only one.
    by
        Size of a clock jump, or time for which the cable is unplugged, s.
    """

    kind: Kind
    sample: Annotated[int, pydantic.Field(ge=0)]
    count: Annotated[int, pydantic.Field(ge=1)] = 1
    target: Annotated[int, pydantic.Field(ge=0, le=0x7FF)] = 0
    by: edge.Seconds = 0.0


Frame: TypeAlias = tuple[int, bytes, float]


def faulty_frames(frames: Iterable[list[Frame]], faults: Sequence[Fault]) -> Iterator[list[Frame]]:
    """Yield the frames of each sample (identifier, data, stamp in s) with the faults applied."""
    late: list[Frame] = []
    jump = 0.0
    for i, sample in enumerate(frames):
        now = [f for f in faults if f.sample <= i < f.sample + f.count]
        jump += sum(f.by for f in now if f.kind == "clock_jump" and f.sample == i)
        if not (now or late or jump):
            yield sample
            continue
        sent: list[Frame] = []
        held: list[Frame] = []
        for identifier, data, stamp in sample:
            frame = (identifier, data, stamp + jump)
            kind = next((f.kind for f in now if f.target == identifier and f.kind in _FRAME_FAULTS), None)
            if kind == "duplicate":
                sent += [frame, frame]
            elif kind == "short":
                sent.append((identifier, data[:-1], frame[2]))
            elif kind == "garbage":
                sent.append((identifier, bytes((i * 37 + k * 101 + 11) % 256 for k in range(1 + i % 3)), frame[2]))
            elif kind == "swap":
                held.append(frame)  # sent after the next sample
            elif kind != "drop":
                sent.append(frame)
        sent += late
        late = held
        yield sent


def at_wrong_baud(data: bytes, factor: float = 0.75) -> bytes:
    """Return the bytes received when sent at 1 / `factor` of the receiver's baud rate, 8 data bits, no parity.

    Start bit 0, data from the lowest bit, stop bit 1; the receiver samples the middle of each of its own bits and
    discards bytes without a stop bit.
    """
    line = [bit for byte in data for bit in (0, *((byte >> k) & 1 for k in range(8)), 1)] + [1] * 12
    got, at = bytearray(), 0.0
    while at < len(line) - 12:
        if line[int(at)]:
            at += 1 / 16
            continue
        bits = [line[min(int(at + (k + 0.5) / factor), len(line) - 1)] for k in range(10)]
        if bits[9]:
            got.append(sum(bit << k for k, bit in enumerate(bits[1:9])))
        at += 9.5 / factor
    return bytes(got)
