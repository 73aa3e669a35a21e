"""Creation of a simulated bench from a few arguments."""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import Any, Literal

from cycloid_fmu import edge
from drivers.arguments import in_si
from drivers.simulated.ads_bench import SimulatedAdsBench
from drivers.simulated.bench import SimulatedBench
from drivers.simulated.faults import read_faults
from drivers.simulated.motion import (
    OutputAngle,
    SimulatedRun,
    fmu_output_angle,
    simulate_hysteresis,
    simulate_motion,
    stated_in_fmu,
)
from drivers.simulated.serial_bench import SERIAL_BENCHES


def simulate_bench(
    drive: OutputAngle | str | os.PathLike[str] | None = None,
    *,
    torque: float | str | None = None,
    ratio: float | None = None,
    pair: str = "",
    turns: int = 39,
    samples_per_turn: int = 96,
    direction: Literal["forward", "backward"] = "forward",
    speed: float | str = 2 * math.pi,
    noise: float | str = 0.0,
    torque_noise: float | str = 0.0,
    seed: int = 0,
    hysteresis: bool = False,
    interface: str = "loopback",
    channel: str | None = None,
    trigger: Literal["controller", "sync", "timer"] = "controller",
    serial: Literal["amt21", "modbus", "ascii"] | None = None,
    plc: str | None = None,
    clock_drift: float = 0.0,
    faults: str | os.PathLike[str] | None = None,
    speed_factor: float | None = None,
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
    turns, samples_per_turn
        Number of crank turns, and samples in each; with `hysteresis`, of loops.
    direction, speed
        Direction and speed of the crank; speed in rad/s, or text such as "60 rpm".
    noise, torque_noise
        RMS noise of each encoder, rad, and of the torque, N*m, or text with a unit.
    seed
        Random seed of the noise.
    hysteresis
        Lock the input and cycle the torque 0, +T, 0, -T, 0.
    interface, channel, trigger
        Interface and channel of the CAN bus in python-can ("loopback" reaches other processes on this machine,
        "virtual" only this process), and the trigger of its encoders, see `SimulatedCanBench`; it needs the extra
        `bench`.
    serial
        Encoders on a pseudo-terminal instead of CAN; "modbus" needs the extra `bench`.
    plc
        A Beckhoff PLC at this address of this machine, such as "127.0.0.1", instead of CAN; recording it needs the
        extra `ads`.
    clock_drift
        Relative drift of the clock of the ASCII counter, the virtual or loopback bus or the PLC against the host's,
        such as 50e-6, > 0: fast.
    faults
        File with a script of faults, `cycloid-faults/1`.
    speed_factor
        Speed relative to real time; None: as fast as a CAN bus permits, 1 on a serial line and for a PLC.

    Raises
    ------
    edge.InputError
        If an argument or a file is invalid.

    Examples
    --------
    >>> import drivers
    >>> with drivers.simulate_bench(ratio=-39, torque="20 N*m", turns=2, interface="virtual") as bench:
    ...     done = bench.record("simulated.arrows")
    >>> done.samples["output_angle"]
    192
    """
    if drive is None and ratio is None:
        raise edge.ArgumentError("ratio", "is missing: give a drive, or the signed ratio of an ideal one")
    stated = stated_in_fmu(drive) if isinstance(drive, str | os.PathLike) else {}
    ratio = stated.get("ratio") if ratio is None else ratio
    torque = stated.get("rated_torque") if torque is None else torque
    if torque is None:
        problem = f"{drive} states no rated_torque" if stated else "only a drive's FMU states a rated_torque"
        raise edge.ArgumentError("torque", f"is missing; give it: {problem}")
    if ratio is not None and not (math.isfinite(ratio) and ratio):
        raise edge.ArgumentError("ratio", f"write the signed ratio input/output: {edge.RATIO}", ratio)
    if speed_factor is not None and not speed_factor > 0:
        raise edge.ArgumentError("speed_factor", "the factor must be above zero", speed_factor)
    if serial is not None and serial not in SERIAL_BENCHES:
        raise edge.ArgumentError("serial", f"it must be one of {', '.join(SERIAL_BENCHES)}", serial)
    if plc is not None and serial is not None:
        raise edge.ArgumentError("plc", "the encoders are either on a serial line or behind a PLC; remove one", plc)
    clocked = plc or serial == "ascii" or (serial is None and interface in ("virtual", "loopback"))
    if clock_drift and not clocked:
        said = 'only a PLC, serial "ascii" and the buses "virtual" and "loopback" have a clock'
        raise edge.ArgumentError("clock_drift", said, clock_drift)
    run = SimulatedRun(
        torque=in_si(torque, "N*m", "torque"),
        turns=turns,
        samples_per_turn=samples_per_turn,
        direction=direction,
        speed=in_si(speed, "rad/s", "speed", above=0.0),
        noise=in_si(noise, "rad", "noise", least=0.0),
        torque_noise=in_si(torque_noise, "N*m", "torque_noise", least=0.0),
        seed=seed,
    )
    name = "ideal"
    if isinstance(drive, str | os.PathLike):
        name, drive = Path(drive).stem, fmu_output_angle(drive)
    moved = simulate_hysteresis if hysteresis else simulate_motion
    motion = moved(drive or (lambda angle, _: angle / (ratio or 1.0)), run)
    script = read_faults(faults) if faults is not None else []
    bench: SimulatedBench
    if plc is not None:
        bench = SimulatedAdsBench(
            motion, host=plc, speed_factor=speed_factor or 1.0, clock_drift=clock_drift, faults=script
        )
    elif serial is None:
        from drivers.simulated.can_bench import SimulatedCanBench  # needs the extra `bench`

        group = "239.74.163.2" if interface == "loopback" else "bench"
        bench = SimulatedCanBench(
            motion,
            interface=interface,
            channel=channel or group,
            trigger=trigger,
            speed_factor=speed_factor,
            clock_drift=clock_drift or None,
            faults=script,
        )
    else:
        options: dict[str, Any] = {"clock_drift": clock_drift} if serial == "ascii" else {}
        bench = SERIAL_BENCHES[serial](motion, speed_factor=speed_factor or 1.0, faults=script, **options)
    bench.ratio, bench.pair = ratio, pair or name
    return bench
