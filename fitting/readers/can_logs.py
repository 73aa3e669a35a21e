"""Logs of CAN buses, decoded with their DBC."""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from cycloid_fmu import edge
from fitting.readers.formats import PIECE, BenchFile, Piece, RawChannel

_SMALLEST_OBJECT = 16  # bytes of a BLF object's header


class CanLog(BenchFile):
    """A log of CAN frames; the channels are the signals of its DBC."""

    def __init__(self, source: str, dbc: str | os.PathLike[str] | None) -> None:
        if dbc is None:
            raise edge.InputError(f"{source}: a CAN log needs the DBC of its frames; name it as dbc in the mapping.")
        self._database = read_dbc(dbc)
        channels = [RawChannel(f"{m.name}.{s.name}", s.unit or "") for m in self._database.messages for s in m.signals]
        super().__init__(source, tuple(channels), timed=True)

    def pieces(self, names: Sequence[str]) -> Iterator[Piece]:
        """Yield pieces of these channels in the order of time."""
        import can

        wanted: dict[int, tuple[Any, list[tuple[str, str]]]] = {}
        for message in self._database.messages:
            signals = [(f"{message.name}.{s.name}", s.name) for s in message.signals]
            chosen = [(full, short) for full, short in signals if full in names]
            if chosen:
                wanted[message.frame_id] = (message, chosen)
        log = _binary_log(self.source) if self.source.lower().endswith(".blf") else can.LogReader(self.source)
        buffers: dict[int, tuple[list[float], list[list[float]]]] = {k: ([], []) for k in wanted}
        failed, count = 0, 0

        def flush() -> Iterator[Piece]:
            for key, (times, rows) in buffers.items():
                if times:
                    table = np.array(rows, float)
                    yield Piece(np.array(times), {full: table[:, i] for i, (full, _) in enumerate(wanted[key][1])})
                    times.clear()
                    rows.clear()

        messages = iter(log)
        while True:
            try:
                frame = next(messages)
            except StopIteration:
                break
            except Exception as problem:  # a truncated or damaged log
                self.problems.append(
                    f"{self.source}: it is truncated or damaged after {count} frames ({edge.first_line(problem)})."
                )
                break
            count += 1
            if frame.arbitration_id not in wanted or frame.is_error_frame or frame.is_remote_frame:
                continue
            message, chosen = wanted[frame.arbitration_id]
            try:
                decoded = message.decode(bytes(frame.data), decode_choices=False)
            except Exception:  # too short for the message, or a multiplexer it does not know
                failed += 1
                continue
            times, rows = buffers[frame.arbitration_id]
            times.append(frame.timestamp)
            rows.append([float(decoded.get(short, np.nan)) for _, short in chosen])
            if len(times) >= PIECE // 4:
                yield from flush()
        yield from flush()
        if failed:
            self.problems.append(f"{self.source}: {failed} frames do not match the DBC and were left out.")


def read_dbc(path: str | os.PathLike[str]) -> Any:
    """Return the database of a DBC file; raise an `edge.InputError` if it can't be read."""
    with edge.needs_extra("bench-files", lambda message: edge.InputError(f"{path}: {message}.")):
        import cantools

    text = edge.read_text(path)
    with edge.parsed_by_others(path, "this is not a DBC file"):
        return cantools.database.load_string(text, "dbc")


def _binary_log(source: str) -> Any:
    """Open a BLF log; refuse objects of size zero, at which python-can would loop forever."""
    import can

    class Checked(can.BLFReader):  # type: ignore[misc]  # python-can is untyped here
        def _parse_container(self, data: bytes) -> Any:
            whole, position = self._tail + data, 0
            while (position := whole.find(b"LOBJ", position, position + 8)) >= 0 and position + 12 <= len(whole):
                (size,) = struct.unpack_from("<I", whole, position + 8)
                if size < _SMALLEST_OBJECT:
                    raise can.io.blf.BLFParseError(f"an object of {size} bytes")
                position += size
            return super()._parse_container(data)

    return Checked(source)
