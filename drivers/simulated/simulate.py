"""Creation of a simulated bench from a few arguments."""

from __future__ import annotations

import dataclasses
import math
import os
from pathlib import Path
from typing import Literal

from cycloid_fmu import edge
from drivers.arguments import in_si
from drivers.simulated import motion as measured
from drivers.simulated.bench import SimulatedBench
from drivers.simulated.buses import SimulatedBus, SimulatedCan
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


def bench_of(bus: SimulatedBus, motion: measured.Motion) -> SimulatedBench:
    """Return the bench that sends a motion over a bus."""
    if isinstance(bus, SimulatedCan):
        from drivers.simulated.can_bench import SimulatedCanBench  # needs the extra `bench`

        return SimulatedCanBench(motion, bus)
    return SERIAL_BENCHES[type(bus)](motion, bus)


def simulate_bench(
    drive: measured.OutputAngle | str | os.PathLike[str] | None = None,
    *,
    torque: float | str | None = None,
    ratio: float | None = None,
    pair: str = "",
    turns: int = 39,
    motion: SimulatedMotion = SimulatedMotion(),
    bus: SimulatedBus | str = SimulatedCan(),
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
    bus
        Description of the bus, see `drivers.simulated.buses`; or the name of a CAN interface, such as "virtual".

    Raises
    ------
    edge.InputError
        If an argument or a file is invalid.

    Examples
    --------
    >>> import drivers
    >>> motion = drivers.SimulatedMotion(speed="120 rpm", noise="0.5 arcsec")
    >>> with drivers.simulate_bench(
    ...     ratio=-39, torque="20 N*m", turns=2, motion=motion, bus="virtual"
    ... ) as bench:
    ...     done = bench.record("simulated.arrows")
    >>> done.samples["output_angle"]
    192
    """
    described = SimulatedCan(interface=bus) if isinstance(bus, str) else bus
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
    bench = bench_of(described, motion.measured(output_angle, torque, turns))
    bench.ratio, bench.pair = ratio, pair or name
    return bench
