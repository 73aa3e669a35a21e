"""Record encoders and torque of a gear test bench, real or simulated.

The names below are those that a notebook needs; each is loaded on first use. A new encoder is a subclass of
`drivers.encoder.Encoder`, see docs/encoder.md.

>>> import drivers
>>> with drivers.simulate_bench(ratio=-39, torque="20 N*m", turns=1, bus="virtual") as bench:
...     done = bench.record("run.arrows")
>>> recording = drivers.read_recording("run.arrows")
>>> recording.samples["input_angle"].value.shape
(96,)
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from drivers.connections import list_connections
    from drivers.encoder import Encoder, EncoderError
    from drivers.live_page.server import watch
    from drivers.recorder.bench import Bench, read_bench
    from drivers.recorder.sequence import run_sequence
    from drivers.recorder.session import record
    from drivers.recording_format import Recording, read_recording
    from drivers.recording_format.export import export
    from drivers.recording_format.repair import repair
    from drivers.simulated.buses import SimulatedAmt21, SimulatedAscii, SimulatedCan, SimulatedModbus
    from drivers.simulated.simulate import SimulatedMotion, simulate_bench

_HOMES = {
    "connections": ("list_connections",),
    "encoder": ("Encoder", "EncoderError"),
    "live_page.server": ("watch",),
    "recorder.bench": ("Bench", "read_bench"),
    "recorder.sequence": ("run_sequence",),
    "recorder.session": ("record",),
    "recording_format": ("Recording", "read_recording"),
    "recording_format.export": ("export",),
    "recording_format.repair": ("repair",),
    "simulated.buses": ("SimulatedAmt21", "SimulatedAscii", "SimulatedCan", "SimulatedModbus"),
    "simulated.simulate": ("SimulatedMotion", "simulate_bench"),
}

__all__ = [
    "Bench",
    "Encoder",
    "EncoderError",
    "Recording",
    "SimulatedAmt21",
    "SimulatedAscii",
    "SimulatedCan",
    "SimulatedModbus",
    "SimulatedMotion",
    "export",
    "list_connections",
    "read_bench",
    "read_recording",
    "record",
    "repair",
    "run_sequence",
    "simulate_bench",
    "watch",
]


def __getattr__(name: str) -> Any:
    for home, names in _HOMES.items():
        if name in names:
            value = getattr(importlib.import_module(f"drivers.{home}"), name)
            globals()[name] = value
            return value
    raise AttributeError(f"module 'drivers' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
