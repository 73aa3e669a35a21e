"""Descriptions of the simulated bench, one for each bus, as values or as a file."""

from __future__ import annotations

import os
from typing import Annotated, Literal, Self

import pydantic

from cycloid_fmu import edge
from drivers.simulated.faults import Fault

FORMAT = "cycloid-simulation/1"


class SimulatedBus(edge.Config):
    """Keys of every simulated bus.

    Attributes
    ----------
    speed_factor
        Speed relative to real time; absent: as fast as a CAN bus permits, 1 on a serial line and with a clock.
    faults
        Faults that the bench simulates; in a file tables such as `[[can.faults]]`.
    """

    speed_factor: Annotated[float, pydantic.Field(gt=0)] | None = None
    faults: tuple[Fault, ...] = ()


class SimulatedCan(SimulatedBus):
    """A `[can]`: two CiA 406 encoders, a torque transducer and a controller; it needs the extra `bench`.

    Attributes
    ----------
    interface, channel
        Interface and channel of python-can: "loopback" reaches other processes on this machine, "virtual" only this
        process.
    trigger
        "controller": the bench sends SYNC; "sync": the bench answers each SYNC of another device, such as the recorder,
        with the next sample; "timer": each node sends by its event timer, without SYNC.
    sync_counter
        Whether the SYNC of the bench has a counter.
    input_counts_per_turn, output_counts_per_turn
        Resolution, powers of two; the 32-bit position counts turns too and rolls over.
    clock_drift
        Virtual and loopback bus: relative drift of the interface's own clock, which counts from power-up, against the
        host's, such as 50e-6, > 0: fast. Absent: the interface has no clock.

    Examples
    --------
    >>> import drivers
    >>> drivers.SimulatedCan(trigger="timer", clock_drift=50e-6).interface
    'loopback'
    """

    interface: str = "loopback"
    channel: str | None = None
    trigger: Literal["controller", "sync", "timer"] = "controller"
    sync_counter: bool = True
    input_counts_per_turn: Annotated[int, pydantic.Field(gt=1)] = 1 << 22
    output_counts_per_turn: Annotated[int, pydantic.Field(gt=1)] = 1 << 25
    clock_drift: float | None = None

    @pydantic.model_validator(mode="after")
    def _clock(self) -> Self:
        if self.clock_drift is not None and self.interface not in ("virtual", "loopback"):
            raise ValueError('clock_drift: only the buses "virtual" and "loopback" have a clock')
        return self


class SimulatedAmt21(SimulatedBus):
    """An `[amt21]`: two AMT21 encoders on one RS-485 line, a pseudo-terminal.

    Attributes
    ----------
    addresses
        Addresses of the input and output encoder.
    bits
        Resolution of one turn, bits.
    multi_turn
        Whether they count turns.
    baud_rate
        Bit rate of the line, bit/s.

    Examples
    --------
    >>> import drivers
    >>> drivers.SimulatedAmt21(bits=12, multi_turn=True).addresses
    (84, 88)
    """

    addresses: tuple[int, int] = (0x54, 0x58)
    bits: Literal[12, 14] = 14
    multi_turn: bool = False
    baud_rate: Annotated[int, pydantic.Field(gt=0)] = 2_000_000


class SimulatedModbus(SimulatedBus):
    """A `[modbus]`: two Modbus RTU encoders on one line, a pseudo-terminal; it needs the extra `bench`.

    Attributes
    ----------
    addresses
        Addresses of the input and output encoder.
    counts_per_turn
        Their resolution.
    baud_rate
        Bit rate of the line, bit/s.

    Examples
    --------
    >>> import drivers
    >>> drivers.SimulatedModbus(counts_per_turn=1 << 20).baud_rate
    115200
    """

    addresses: tuple[int, int] = (1, 2)
    counts_per_turn: Annotated[int, pydantic.Field(gt=1)] = 1 << 18
    baud_rate: Annotated[int, pydantic.Field(gt=0)] = 115_200


class SimulatedAscii(SimulatedBus):
    """An `[ascii]`: a counter of the output angle that sends lines on its own, on a pseudo-terminal.

    Attributes
    ----------
    counts_per_turn
        Its resolution.
    clock_drift
        Relative drift of its clock against the host's, > 0: fast.
    baud_rate
        Bit rate of the line, bit/s.

    Examples
    --------
    >>> import drivers
    >>> drivers.SimulatedAscii(clock_drift=50e-6).counts_per_turn
    360000
    """

    counts_per_turn: Annotated[int, pydantic.Field(gt=1)] = 360_000
    clock_drift: float = 0.0
    baud_rate: Annotated[int, pydantic.Field(gt=0)] = 921_600


class SimulationFile(edge.Config):
    """Content of a `SIMULATION.toml`: one table with the keys of a bus; without one the bus is a CAN bus."""

    can: SimulatedCan | None = None
    amt21: SimulatedAmt21 | None = None
    modbus: SimulatedModbus | None = None
    ascii: SimulatedAscii | None = None


def read_simulation(path: str | os.PathLike[str]) -> SimulatedBus:
    """Read a `SIMULATION.toml`.

    Raises
    ------
    edge.InputError
        If the file is invalid; names file, table and key.
    """
    table = edge.toml_table(edge.read_text(path, FORMAT), FORMAT, str(path))
    file = edge.validated(SimulationFile, table, str(path))
    stated: list[SimulatedBus] = [bus for bus in (file.can, file.amt21, file.modbus, file.ascii) if bus is not None]
    if len(stated) > 1:
        raise edge.InputError(f"{path}: it has several buses; write one of [can], [amt21], [modbus] and [ascii].")
    return stated[0] if stated else SimulatedCan()
