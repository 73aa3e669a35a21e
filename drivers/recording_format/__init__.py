"""The bench recording, `cycloid-recording/1`: schema, writer, reader and device clocks.

It needs no bus library. `schema` defines the format; `export` and `repair` are the tools for finished files.
"""

from drivers.recording_format.clocks import CLOCK_JUMP, Alignment, Clock, ClockJumps, clock_event
from drivers.recording_format.limits import LARGEST_DEVIATION_KEY, Finding, Limits, limits_of
from drivers.recording_format.plausibility import Plausibility
from drivers.recording_format.reader import Recording, RecordingReader, read_clocks, read_recording
from drivers.recording_format.schema import (
    ANGLES,
    CHECKSUM,
    DUPLICATE,
    FORMAT,
    GAP,
    IMPLAUSIBLE,
    MARKS,
    OUT_OF_ORDER,
    RESET,
    ROLES,
    ROLLOVER,
    Channel,
    Event,
    FloatArray,
    Header,
    IntArray,
    Samples,
    joined,
)
from drivers.recording_format.writer import FLUSH_SECONDS, RecordingWriter, check_new

__all__ = [
    "ANGLES",
    "CHECKSUM",
    "CLOCK_JUMP",
    "DUPLICATE",
    "FLUSH_SECONDS",
    "FORMAT",
    "GAP",
    "IMPLAUSIBLE",
    "LARGEST_DEVIATION_KEY",
    "MARKS",
    "OUT_OF_ORDER",
    "RESET",
    "ROLES",
    "ROLLOVER",
    "Alignment",
    "Channel",
    "Clock",
    "ClockJumps",
    "Event",
    "Finding",
    "FloatArray",
    "Header",
    "IntArray",
    "Limits",
    "Plausibility",
    "Recording",
    "RecordingReader",
    "RecordingWriter",
    "Samples",
    "check_new",
    "clock_event",
    "joined",
    "limits_of",
    "read_clocks",
    "read_recording",
]
