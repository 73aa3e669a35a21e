"""Plug-ins of a bench file: the base class of encoders and actuators, and their registration by entry points."""

from __future__ import annotations

import abc
import dataclasses
import importlib.metadata
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, ClassVar, Self, TypeVar

from cycloid_fmu import edge
from drivers.lines import LineConfig

Line = TypeVar("Line", bound=LineConfig)


class PlugInConfig(edge.Config):
    """Keys of every table that a plug-in reads; each protocol adds its own.

    Attributes
    ----------
    protocol
        Name of the protocol.
    """

    protocol: str


@dataclasses.dataclass(frozen=True)
class Wiring:
    """The part of a `BENCH.toml` that a plug-in sees.

    Attributes
    ----------
    lines
        Buses, ports and other lines by kind and name.
    folder
        Base folder of the file names in it.
    source
        The file's own name.
    table
        Table of the plug-in, such as "[channel.torque]", for messages.
    """

    lines: Mapping[str, Mapping[str, LineConfig]]
    folder: Path
    source: str
    table: str = ""

    def line(self, kind: type[Line], name: str) -> Line:
        """Return the line of this kind and name; an `edge.InputError` names the plug-in's table if there is none."""
        named = self.lines.get(kind.kind, {})
        line = named.get(name)
        if not isinstance(line, kind):
            raise edge.InputError(
                f"{self.source}: {self.table} {kind.kind} = {edge.shown(name)}: there is no {kind.kind} of this name; "
                f"the file has {', '.join(map(edge.shown, named)) or 'none'}."
            )
        return line


class PlugIn(abc.ABC):
    """What a table of a `BENCH.toml` describes; a context manager that opens and closes it.

    Parameters
    ----------
    name
        Name of the channel, or "actuator".
    config
        The table.
    line
        The table of its line; None: it has none.

    Attributes
    ----------
    group
        Entry points that register its protocols.
    configuration
        The keys of its table.
    line
        Class of the table of a line that it shares with others, see `LineConfig`; the plug-in's table names the line by
        the key `line.kind`. None: it has none.
    """

    group: ClassVar[str]
    configuration: ClassVar[type[PlugInConfig]]
    line: ClassVar[type[LineConfig] | None] = None

    def __init__(self, name: str, config: Any, line: Any = None) -> None:
        self.name, self.config, self.line_config = name, config, line

    @classmethod
    def from_config(cls, name: str, config: Any, wiring: Wiring) -> Self:
        """Return the plug-in that a table of a `BENCH.toml` describes, not yet opened.

        Raises
        ------
        edge.InputError
            If the table names a line or file that does not exist, or contradicts itself.
        """
        line = None if cls.line is None else wiring.line(cls.line, getattr(config, cls.line.kind))
        try:
            return cls(name, config, line)
        except edge.InputError as problem:
            raise edge.InputError(f"{wiring.source}: {wiring.table} {problem}") from None

    @abc.abstractmethod
    def __enter__(self) -> Self:
        """Open the device.

        Raises
        ------
        EncoderError
            If the line or the device does not answer, or its answer is invalid.
        """

    @abc.abstractmethod
    def close(self) -> None:
        """Release the line and the device; closing twice is allowed."""

    def __exit__(
        self, kind: type[BaseException] | None, problem: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


Kind = TypeVar("Kind", bound=PlugIn)


def registered(group: str) -> importlib.metadata.EntryPoints:
    """Return the entry points of a group of all installed packages, whose files are read."""
    return importlib.metadata.entry_points(group=group)


def plug_in(
    base: type[Kind], protocol: object, table: str, source: str, installed: importlib.metadata.EntryPoints
) -> type[Kind]:
    """Return the class of a protocol, from this package or another installed one.

    Parameters
    ----------
    base
        Class from which it must derive.
    protocol, table, source
        Protocol that a table of a bench file states, such as "[channel.torque]", and the names of both.
    installed
        The entry points that are `registered` in the group of `base`.

    Raises
    ------
    edge.InputError
        If no installed package provides the protocol, two do, or its class does not load; names table and file.
    """
    known = {e.name: e for e in installed}
    names = ", ".join(sorted(known)) or "none"
    if protocol is None:
        raise edge.InputError(f"{source}: {table} protocol is missing; installed are {names}.")
    where = f"{source}: {table} protocol = {edge.shown(protocol)}"
    if not isinstance(protocol, str) or protocol not in known:
        raise edge.InputError(f"{where}: no such protocol is installed; installed are {names}.")
    owners = {e.dist.name for e in installed.select(name=protocol) if e.dist}
    if len(owners) > 1:
        raise edge.InputError(f"{where}: the packages {' and '.join(sorted(owners))} both provide it; uninstall one.")
    owner = "".join(owners) or known[protocol].value
    try:
        loaded = known[protocol].load()
    except edge.InputError as problem:  # an extra that is not installed
        raise edge.InputError(f"{where}: {problem}") from None
    except Exception as problem:  # a plug-in's module may raise anything
        cause = str(problem).rstrip(".") or type(problem).__name__
        raise edge.InputError(f"{where}: the package {owner} that provides it does not load: {cause}.") from problem
    if not (isinstance(loaded, type) and issubclass(loaded, base) and hasattr(loaded, "configuration")):
        raise edge.InputError(
            f"{where}: the package {owner} must provide a subclass of {base.__name__} with a configuration, "
            f"not {loaded!r}."
        )
    return loaded
