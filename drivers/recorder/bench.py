"""The `BENCH.toml`: channels, and their buses, ports and PLCs."""

from __future__ import annotations

import contextlib
import dataclasses
import os
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import pydantic

from cycloid_fmu import edge
from drivers import recording_format as rf
from drivers.encoder import (
    BusConfig,
    ChannelConfig,
    Encoder,
    PlcConfig,
    PortConfig,
    Wiring,
    encoder_class,
    registered,
)
from drivers.lines import check_lines

BENCH_FORMAT = "cycloid-bench/1"


class Conditions(edge.Config):
    """Content of `[conditions]`: signed load on the output, N*m, speed, rad/s, temperature, K, direction, note."""

    load: edge.Torque | None = None
    speed: edge.Speed | None = None
    direction: Literal["forward", "backward"] | None = None
    temperature: edge.Temperature | None = None
    note: str | None = None


class _BenchFile(edge.Config):
    ratio: float | None = None
    pair: str = ""
    largest_deviation: Annotated[edge.Angle, pydantic.Field(gt=0)] | None = None
    conditions: Conditions = Conditions()
    bus: dict[str, BusConfig] = pydantic.Field(default_factory=dict)
    port: dict[str, PortConfig] = pydantic.Field(default_factory=dict)
    plc: dict[str, PlcConfig] = pydantic.Field(default_factory=dict)
    channel: dict[str, dict[str, Any]]

    @pydantic.field_validator("ratio")
    @classmethod
    def _ratio(cls, value: float | None) -> float | None:
        if value is not None and not 0 < abs(value) < float("inf"):
            raise ValueError(f"write the signed ratio input/output of the ideal drive: {edge.RATIO}")
        return value

    @pydantic.field_validator("channel")
    @classmethod
    def _some(cls, value: dict[str, Any]) -> dict[str, Any]:
        if not value:
            raise ValueError("write at least one table [channel.input_angle]")
        if any(not name.isprintable() for name in value):
            raise ValueError("a channel's name must be printable")
        return value


@dataclasses.dataclass(frozen=True)
class Bench:
    """The wiring of a bench.

    Attributes
    ----------
    ratio
        Signed input/output ratio of the ideal drive, or None.
    pair
        Name of the gear pair.
    conditions
        SI numbers and text: load N*m, speed rad/s, direction, temperature K, note, and largest_deviation rad, the
        largest deviation of the output angle from input angle / ratio. Those not stated are absent.
    channels
        Class and configuration of each channel's encoder, by the channel's name.
    wiring
        Buses, ports and PLCs.

    Examples
    --------
    >>> import drivers
    >>> with drivers.simulate_bench(ratio=-39, torque=20.0, turns=1, connection="virtual") as simulated:
    ...     bench = drivers.read_bench(simulated.write_wiring("BENCH.toml"))
    >>> bench.conditions["load"]
    20.0
    """

    ratio: float | None
    pair: str
    conditions: Mapping[str, float | str]
    channels: Mapping[str, tuple[type[Encoder], ChannelConfig]]
    wiring: Wiring

    def encoders(self) -> list[Encoder]:
        """Return new encoders for all channels, not yet opened."""
        return [cls.from_config(name, config, self.wiring) for name, (cls, config) in self.channels.items()]


def read_bench(path: str | os.PathLike[str], *, allow: Collection[str] = ()) -> Bench:
    """Read a `BENCH.toml` and check it as far as possible without a device.

    Parameters
    ----------
    path
        The file.
    allow
        Connections allowed in addition to serial devices, `socket://` and the buses of `drivers.lines`: URL schemes of
        pyserial and interfaces of python-can, such as "rfc2217".

    Raises
    ------
    edge.InputError
        If the file is invalid; names file, table and key.

    Examples
    --------
    >>> import drivers
    >>> with drivers.simulate_bench(ratio=-39, torque=20.0, turns=1, connection="virtual") as simulated:
    ...     bench = drivers.read_bench(simulated.write_wiring("BENCH.toml"))
    >>> bench.ratio, list(bench.channels)
    (-39.0, ['input_angle', 'output_angle', 'torque'])
    """
    source = str(path)
    table = edge.toml_table(edge.read_text(path, BENCH_FORMAT), BENCH_FORMAT, source)
    file = edge.validated(_BenchFile, table, source)
    check_lines(file.bus, file.port, allow, source)
    channels, installed = {}, registered()
    for name, given in file.channel.items():
        cls = encoder_class(given.get("protocol"), name, source, installed)
        channels[name] = (cls, edge.validated(cls.configuration, given, f"{source}: [channel.{name}]"))
    wiring = Wiring(file.bus, file.port, Path(path).parent, source, file.plc)
    conditions = file.conditions.model_dump(exclude_none=True)
    if file.largest_deviation is not None:
        conditions[rf.LARGEST_DEVIATION_KEY] = file.largest_deviation
    bench = Bench(file.ratio, file.pair, conditions, channels, wiring)
    bench.encoders()
    return bench


@contextlib.contextmanager
def open_encoders(bench: Bench | str | os.PathLike[str]) -> Iterator[list[Encoder]]:
    """Open all encoders of a bench, or of the `BENCH.toml` of this path, then start all; close all at the end.

    Raises
    ------
    edge.InputError
        If the file is invalid.
    EncoderError
        If a bus, port or device does not answer.
    """
    encoders = (bench if isinstance(bench, Bench) else read_bench(bench)).encoders()
    with contextlib.ExitStack() as stack:
        for encoder in encoders:
            stack.enter_context(encoder)
        for encoder in encoders:
            encoder.start()
        yield encoders
