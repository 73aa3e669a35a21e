"""Record over CAN
===============

Two CANopen encoders and a torque transducer, from Python.

A simulated bench in a thread stands in for yours: leave it out, and name your own bus in bench.toml, such as
interface = "socketcan", channel = "can0".
"""

from pathlib import Path

import numpy as np

from drivers.simulated.can_bench import SimulatedCanBench
from drivers.simulated.motion import SimulatedRun, simulate_motion
from drivers.recorder.session import record_bench
from drivers.recording_format import read_recording

OUT = Path("record_can_out")


def main() -> None:
    OUT.mkdir(exist_ok=True)
    path = OUT / "run.arrows"
    path.unlink(missing_ok=True)
    run = SimulatedRun(torque=-20.0, turns=2, noise=2e-6, torque_noise=0.1)
    with SimulatedCanBench(simulate_motion(lambda angle, torque: -angle / 39 + 1e-6 * torque, run)) as bench:
        wiring = bench.write_wiring(OUT / "bench.toml", ratio=-39.0, pair="drive-39-40")

        done = record_bench(wiring, path, samples=run.samples, idle=5.0)

    recording = read_recording(path)
    for channel in recording.header.channels:
        samples = recording.samples[channel.name]
        print(f"{channel.name}: {len(samples)} samples in {channel.unit}; {channel.time_source}; {channel.identity}")
    angle, output = recording.samples["input_angle"], recording.samples["output_angle"]
    error = output.value - angle.value / -39.0  # both angles were latched by the same SYNC
    print(f"TE {np.degrees(error.mean()) * 3600:.2f} arcsec in the mean; marks {done.marks}; {done.events} events")


if __name__ == "__main__":
    main()
