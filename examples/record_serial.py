"""Record over a serial port
=========================

A line-based counter, from Python, with its clock converted to the host's.

A simulated counter on a pseudo-terminal replaces yours: leave it out, and state your port in bench.toml, such as
url = "/dev/ttyUSB0". Its clock runs 50 ppm fast, and its lines are late by the delays of the scheduler.
"""

from pathlib import Path

import numpy as np

import drivers

OUT = Path("record_serial_out")


def main() -> None:
    OUT.mkdir(exist_ok=True)
    path = OUT / "run.arrows"
    path.unlink(missing_ok=True)
    counter = drivers.simulate_bench(
        ratio=-39,
        torque=0.0,
        turns=3,
        motion=drivers.SimulatedMotion(samples_per_turn=200),
        bus=drivers.SimulatedAscii(clock_drift=50e-6),
    )
    with counter:
        wiring = counter.write_wiring(OUT / "bench.toml")

        done = drivers.record(wiring, path, idle="0.5 s")

    recording = drivers.read_recording(path)
    samples, clock = recording.samples["output_angle"], recording.clock("output_angle")
    print(f"{len(samples)} lines; marks {done.marks}; {done.events} events")
    if clock is not None:
        late = samples.time_host - recording.aligned_time("output_angle")
        print(
            f"clock: drift {clock.drift * 1e6:+.1f} ppm, uncertainty {clock.uncertainty * 1e6:.0f} us; "
            f"delay of lines: median {np.median(late) * 1e6:.0f} us, largest {late.max() * 1e6:.0f} us"
        )


if __name__ == "__main__":
    main()
