"""Creation of a simulated bench from a few arguments."""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

from cycloid_fmu import edge
from drivers.arguments import in_si
from drivers.simulated import motion as measured
from drivers.simulated.bench import SimulatedBench
from drivers.simulated.faults import Fault, read_faults
from drivers.simulated.serial_bench import SERIAL_BENCHES


@dataclasses.dataclass(frozen=True)
class SimulatedMotion:
    """How the crank of a simulated bench moves and is sampled, and the noise of its sensors.

    Attributes
    ----------
    samples_per_turn
        Samples in each crank turn; with `hysteresis`, in each loop.
    direction, speed
        Direction and speed of the crank; speed in rad/s, or text such as "60 rpm".
    noise, torque_noise
        RMS noise of each encoder, rad, and of the torque, N*m, or text with a unit.
    seed
        Random seed of the noise.
    hysteresis
        Lock the input and cycle the torque 0, +T, 0, -T, 0.

    Examples
    --------
    >>> import drivers
    >>> drivers.SimulatedMotion(direction="backward", speed="60 rpm").samples_per_turn
    96
    """

    samples_per_turn: int = 96
    direction: Literal["forward", "backward"] = "forward"
    speed: float | str = 2 * math.pi
    noise: float | str = 0.0
    torque_noise: float | str = 0.0
    seed: int = 0
    hysteresis: bool = False

    def measured(self, output_angle: measured.OutputAngle, torque: float | str, turns: int) -> measured.Motion:
        """Return the measured motion of a drive over crank turns, or loops, at a torque on the output, N*m or text."""
        run = measured.SimulatedRun(
            torque=in_si(torque, "N*m", "torque"),
            turns=turns,
            samples_per_turn=self.samples_per_turn,
            direction=self.direction,
            speed=in_si(self.speed, "rad/s", "speed", above=0.0),
            noise=in_si(self.noise, "rad", "noise", least=0.0),
            torque_noise=in_si(self.torque_noise, "N*m", "torque_noise", least=0.0),
            seed=self.seed,
        )
        return (measured.simulate_hysteresis if self.hysteresis else measured.simulate_motion)(output_angle, run)


@dataclasses.dataclass(frozen=True)
class SimulatedConnection:
    """How a recorder reaches a simulated bench: by a CAN bus or a serial line.

    Attributes
    ----------
    interface, channel, trigger
        Interface and channel of the CAN bus in python-can ("loopback" reaches other processes on this machine,
        "virtual" only this process), and the trigger of its encoders, see `SimulatedCanBench`; it needs the extra
        `bench`.
    serial
        Encoders on a pseudo-terminal instead of CAN; "modbus" needs the extra `bench`.
    clock_drift
        Relative drift of the clock of the ASCII counter, or of the virtual or loopback bus, against the host's,
        such as 50e-6, > 0: fast.
    speed_factor
        Speed relative to real time; None: as fast as a CAN bus permits, 1 on a serial line.

    Raises
    ------
    edge.ArgumentError
        If a value is invalid, or two contradict each other.

    Examples
    --------
    >>> import drivers
    >>> drivers.SimulatedConnection(serial="amt21", speed_factor=2.0).interface
    'loopback'
    """

    interface: str = "loopback"
    channel: str | None = None
    trigger: Literal["controller", "sync", "timer"] = "controller"
    serial: Literal["amt21", "modbus", "ascii"] | None = None
    clock_drift: float = 0.0
    speed_factor: float | None = None

    def __post_init__(self) -> None:
        if self.speed_factor is not None and not self.speed_factor > 0:
            raise edge.ArgumentError("speed_factor", "the factor must be above zero", self.speed_factor)
        if self.serial is not None and self.serial not in SERIAL_BENCHES:
            raise edge.ArgumentError("serial", f"it must be one of {', '.join(SERIAL_BENCHES)}", self.serial)
        on_bus = self.serial is None and self.interface in ("virtual", "loopback")
        if self.clock_drift and not (self.serial == "ascii" or on_bus):
            problem = 'only serial "ascii" and the buses "virtual" and "loopback" have a clock'
            raise edge.ArgumentError("clock_drift", problem, self.clock_drift)

    def bench(self, motion: measured.Motion, faults: Sequence[Fault]) -> SimulatedBench:
        """Return a bench that sends a motion in this way."""
        pace = self.speed_factor or 1.0
        if self.serial is not None:
            options: dict[str, Any] = {"clock_drift": self.clock_drift} if self.serial == "ascii" else {}
            return SERIAL_BENCHES[self.serial](motion, speed_factor=pace, faults=faults, **options)
        from drivers.simulated.can_bench import SimulatedCanBench  # needs the extra `bench`

        return SimulatedCanBench(
            motion,
            interface=self.interface,
            channel=self.channel or ("239.74.163.2" if self.interface == "loopback" else "bench"),
            trigger=self.trigger,
            speed_factor=self.speed_factor,
            clock_drift=self.clock_drift or None,
            faults=faults,
        )


def simulate_bench(
    drive: measured.OutputAngle | str | os.PathLike[str] | None = None,
    *,
    torque: float | str | None = None,
    ratio: float | None = None,
    pair: str = "",
    turns: int = 39,
    motion: SimulatedMotion = SimulatedMotion(),
    connection: SimulatedConnection | str = SimulatedConnection(),
    faults: str | os.PathLike[str] | None = None,
) -> SimulatedBench:
    """Return a bench that waits for a recorder and then sends the signals of a motion as real sensors do.

    A context manager: inside `with` the bench is connected to its bus or port. `write_wiring` writes a `BENCH.toml` for
    recording it; `record` records the whole motion at once.

    Parameters
    ----------
    drive
        The drive: its FMU, or a function of crank angles, rad, and torques, N*m, both of shape (n,) in the order of
        time, that returns output angles, rad. None: an ideal drive of the `ratio`.
    torque
        Torque on the output, N*m, counter-clockwise positive for both directions of rotation, or text such as "20 N*m".
        By default the rated torque that the drive's FMU states.
    ratio
        Signed ratio input/output: -gear_teeth with a fixed ring, +pins with a fixed carrier, such as -39. By default
        the ratio that the drive's FMU states.
    pair
        Name or fingerprint of the gear pair for the wiring and the recording; default: the FMU's name.
    turns
        Number of crank turns; of loops with `SimulatedMotion.hysteresis`.
    motion
        Speed, direction and sampling of the crank, and noise.
    connection
        CAN bus or serial line, or the name of a CAN interface such as "virtual".
    faults
        File with a script of faults, `cycloid-faults/1`.

    Raises
    ------
    edge.InputError
        If an argument or a file is invalid.

    Examples
    --------
    >>> import drivers
    >>> motion = drivers.SimulatedMotion(speed="120 rpm", noise="0.5 arcsec")
    >>> with drivers.simulate_bench(
    ...     ratio=-39, torque="20 N*m", turns=2, motion=motion, connection="virtual"
    ... ) as bench:
    ...     done = bench.record("simulated.arrows")
    >>> done.samples["output_angle"]
    192
    """
    if isinstance(connection, str):
        connection = SimulatedConnection(connection)
    if drive is None and ratio is None:
        raise edge.ArgumentError("ratio", "is missing: give a drive, or the signed ratio of an ideal one")
    stated = measured.stated_in_fmu(drive) if isinstance(drive, str | os.PathLike) else {}
    ratio = stated.get("ratio") if ratio is None else ratio
    torque = stated.get("rated_torque") if torque is None else torque
    if torque is None:
        problem = f"{drive} states no rated_torque" if stated else "only a drive's FMU states a rated_torque"
        raise edge.ArgumentError("torque", f"is missing; give it: {problem}")
    if ratio is not None and not (math.isfinite(ratio) and ratio):
        raise edge.ArgumentError("ratio", f"write the signed ratio input/output: {edge.RATIO}", ratio)
    name = "ideal"
    if isinstance(drive, str | os.PathLike):
        name, drive = Path(drive).stem, measured.fmu_output_angle(drive)
    output_angle = drive or (lambda angle, _: angle / (ratio or 1.0))
    script = read_faults(faults) if faults is not None else []
    bench = connection.bench(motion.measured(output_angle, torque, turns), script)
    bench.ratio, bench.pair = ratio, pair or name
    return bench
