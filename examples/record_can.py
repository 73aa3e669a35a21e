"""Record over CAN
===============

Two CANopen encoders and a torque transducer, from Python.

A simulated bench in a thread replaces yours: leave it out, and state your bus in bench.toml, such as
interface = "socketcan", channel = "can0".
"""

from pathlib import Path

import numpy as np

import drivers

OUT = Path("record_can_out")


def drive(angle, torque):
    """An ideal drive with a compliance of 1e-6 rad/(N m)."""
    return -angle / 39 + 1e-6 * torque


def main() -> None:
    OUT.mkdir(exist_ok=True)
    path = OUT / "run.arrows"
    path.unlink(missing_ok=True)
    bench = drivers.simulate_bench(
        drive,
        torque="-20 N*m",
        ratio=-39,
        turns=2,
        motion=drivers.SimulatedMotion(noise="0.4 arcsec", torque_noise="0.1 N*m"),
        bus="virtual",
    )
    with bench:
        wiring = bench.write_wiring(OUT / "bench.toml")

        done = drivers.record(wiring, path, samples=192, idle="5 s")

    recording = drivers.read_recording(path)
    for channel in recording.header.channels:
        samples = recording.samples[channel.name]
        print(f"{channel.name}: {len(samples)} samples in {channel.unit}; {channel.time_source}; {channel.identity}")
    angle, output = recording.samples["input_angle"], recording.samples["output_angle"]
    error = output.value - angle.value / -39.0  # both angles were latched by the same SYNC
    print(f"TE {np.degrees(error.mean()) * 3600:.2f} arcsec mean; marks {done.marks}; {done.events} events")


if __name__ == "__main__":
    main()
