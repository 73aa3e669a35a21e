"""The `BENCH.toml`: channels, and the buses, ports and other lines that they share."""

from __future__ import annotations

import contextlib
import dataclasses
import os
from collections.abc import Collection, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import pydantic

from cycloid_fmu import edge
from drivers import recording_format as rf
from drivers.encoder import ChannelConfig, Encoder
from drivers.lines import BusConfig, LineConfig, PortConfig
from drivers.plug_in import PlugIn, Wiring, plug_in, registered
from drivers.recorder.actuator import Actuator, ActuatorConfig

BENCH_FORMAT = "cycloid-bench/1"


class Conditions(edge.Config):
    """Content of `[conditions]`: what is stated of every recording of this bench.

    Attributes
    ----------
    load
        Signed load on the output, N*m.
    speed
        Speed, rad/s.
    direction
        Direction of the rotation.
    temperature
        Temperature, K.
    note
        Any text.
    """

    load: edge.Torque | None = None
    speed: edge.Speed | None = None
    direction: Literal["forward", "backward"] | None = None
    temperature: edge.Temperature | None = None
    note: str | None = None


class _BenchFile(edge.Config):
    """Content of a `BENCH.toml`: buses, ports and channels of a test bench, and its drive.

    Attributes
    ----------
    ratio
        Signed ratio input/output of the ideal drive.
    pair
        Name of the drive, which the recording states.
    largest_deviation
        Largest deviation of the output angle from the input angle over the ratio, rad; more is implausible. 1 deg where
        not stated.
    actuator
        A plug-in that sets torque and speed of the steps of a sequence, and its keys.
    channel
        The channels by name: `[channel.input_angle]`, `[channel.output_angle]`, `[channel.torque]` and others.
    """

    ratio: float | None = None
    pair: str = ""
    largest_deviation: Annotated[edge.Angle, pydantic.Field(gt=0)] | None = None
    conditions: Conditions = Conditions()
    actuator: dict[str, Any] | None = None
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


def bench_file(lines: Iterable[type[LineConfig]] = (BusConfig, PortConfig)) -> type[_BenchFile]:
    """Return the class of a `BENCH.toml` with tables of these lines."""
    tables: dict[str, Any] = {c.kind: (dict[str, c], pydantic.Field(default_factory=dict)) for c in lines}  # type: ignore[valid-type]
    return pydantic.create_model("BenchFile", __base__=_BenchFile, __doc__=_BenchFile.__doc__, **tables)


def _line_kinds(users: Mapping[str, type[LineConfig] | None], source: str) -> dict[str, type[LineConfig]]:
    """Return the lines of this package and of plug-ins by kind, given the line of each table that uses one."""
    kinds: dict[str, type[LineConfig]] = {c.kind: c for c in (BusConfig, PortConfig)}
    for table, line in users.items():
        if line is None:
            continue
        if line.kind in _BenchFile.model_fields or kinds.setdefault(line.kind, line) is not line:
            raise edge.InputError(
                f"{source}: {table}: its package's table [{line.kind}.NAME] is another one's in this file."
            )
    return kinds


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
        Buses, ports and other lines.
    actuator
        Class and configuration of what drives the bench; None: nothing that the package knows of.

    Examples
    --------
    >>> import drivers
    >>> with drivers.simulate_bench(ratio=-39, torque=20.0, turns=1, bus="virtual") as simulated:
    ...     bench = drivers.read_bench(simulated.write_wiring("BENCH.toml"))
    >>> bench.conditions["load"]
    20.0
    """

    ratio: float | None
    pair: str
    conditions: Mapping[str, float | str]
    channels: Mapping[str, tuple[type[Encoder], ChannelConfig]]
    wiring: Wiring
    actuator: tuple[type[Actuator], ActuatorConfig] | None = None

    def encoders(self) -> list[Encoder]:
        """Return new encoders for all channels, not yet opened."""
        return [
            cls.from_config(name, config, dataclasses.replace(self.wiring, table=f"[channel.{name}]"))
            for name, (cls, config) in self.channels.items()
        ]

    def new_actuator(self) -> Actuator | None:
        """Return a new actuator, not yet opened; None: the bench has none."""
        if self.actuator is None:
            return None
        cls, config = self.actuator
        return cls.from_config("actuator", config, dataclasses.replace(self.wiring, table="[actuator]"))


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
    >>> with drivers.simulate_bench(ratio=-39, torque=20.0, turns=1, bus="virtual") as simulated:
    ...     bench = drivers.read_bench(simulated.write_wiring("BENCH.toml"))
    >>> bench.ratio, list(bench.channels)
    (-39.0, ['input_angle', 'output_angle', 'torque'])
    """
    source = str(path)
    table = edge.toml_table(edge.read_text(path, BENCH_FORMAT), BENCH_FORMAT, source)
    channels, actuator = table.get("channel"), table.get("actuator")
    tables = {f"[channel.{name}]": keys for name, keys in channels.items()} if isinstance(channels, dict) else {}
    classes: dict[str, Any] = _classes(Encoder, tables, source)  # type: ignore[type-abstract]
    classes |= _classes(Actuator, {"[actuator]": actuator}, source)  # type: ignore[type-abstract]
    kinds = _line_kinds({where: cls.line for where, cls in classes.items()}, source)
    file = edge.validated(bench_file(kinds.values()), table, source)
    lines: dict[str, dict[str, LineConfig]] = {kind: getattr(file, kind) for kind in kinds}
    for kind, named in lines.items():
        for name, line in named.items():
            if refusal := line.refusal(allow):
                raise edge.InputError(f"{source}: [{kind}.{name}] {refusal}.")
    tables["[actuator]"] = file.actuator
    plug_ins = {
        where: (cls, edge.validated(cls.configuration, tables[where], f"{source}: {where}"))
        for where, cls in classes.items()
    }
    conditions = file.conditions.model_dump(exclude_none=True)
    if file.largest_deviation is not None:
        conditions[rf.LARGEST_DEVIATION_KEY] = file.largest_deviation
    driven_by = plug_ins.pop("[actuator]", None)
    encoders = dict(zip(file.channel, plug_ins.values(), strict=True))
    bench = Bench(file.ratio, file.pair, conditions, encoders, Wiring(lines, Path(path).parent, source), driven_by)
    bench.encoders()
    bench.new_actuator()
    return bench


def _classes(base: type[PlugIn], tables: Mapping[str, Any], source: str) -> dict[str, type[PlugIn]]:
    """Return the plug-in of each table, by the table's name; values that are no table are left to the validation."""
    installed = registered(base.group)
    return {
        where: plug_in(base, keys.get("protocol"), where, source, installed)
        for where, keys in tables.items()
        if isinstance(keys, dict)
    }


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
