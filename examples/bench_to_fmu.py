"""From a bench run to the FMU of that very drive
==============================================

A simulated bench stands in for the real one: it turns the FMU of a drive with known errors and sends CANopen encoder
frames over a virtual CAN bus. From there on everything is what you would do with your own drive: record, make the
transmission error curves, identify the errors, write the error surface, build the FMU, simulate it, compare.
"""

from pathlib import Path

import numpy as np

from cycloid_fmu.fmu.build import build_fmu
from cycloid_fmu.fmu.run import follow
from cycloid_fmu.pair import read_pair
from cycloid_fmu.plots import save
from cycloid_fmu.surface import read_surface, structured_value, surface_of_pair, write_surface
from drivers.bench import BenchRun, CanBench, fmu_output_angle, simulate_motion
from drivers.recorder import record_bench
from fitting.cli import print_identification
from fitting.curve import transmission_error_curve
from fitting.identification import write_identification
from fitting.identify import identify
from fitting.plots import plot_comparison
from fitting.recording import read_bench_recording

HERE, OUT = Path(__file__).parent, Path("bench_to_fmu_out")
ARCSEC = np.pi / 648000


def main() -> None:
    OUT.mkdir(exist_ok=True)

    print("1. The drive on the bench: an FMU of the drive as it was really made")
    as_made = read_pair(HERE / "drive-39-40-as-made.toml")
    build_fmu(as_made, OUT / "as-made.fmu")
    drive = fmu_output_angle(OUT / "as-made.fmu")

    print("2. The bench runs at two loads in both directions, and the recorder writes what its encoders send")
    recordings = []
    for load in (20.0, 200.0):
        for direction, sign in (("forward", 1.0), ("backward", -1.0)):  # a brake: the torque opposes the motion
            run = BenchRun(
                torque=sign * load, turns=39, samples_per_turn=48, direction=direction, noise=0.5 * ARCSEC,
                torque_noise=0.2, seed=len(recordings),
            )  # fmt: skip
            path = OUT / f"{load:g}Nm-{direction}.arrows"
            path.unlink(missing_ok=True)
            with CanBench(simulate_motion(drive, run)) as bench:
                wiring = bench.write_wiring(OUT / "bench.toml", ratio=as_made.ratio, pair="drive-39-40")
                done = record_bench(wiring, path, samples=run.samples, idle=5.0)
            print(f"   {path}: {min(done.samples.values())} samples a channel")
            recordings.append(path)

    print("3. Transmission error curves, and the errors behind them")
    nominal = read_pair(HERE / "drive-39-40.toml")
    curves = [transmission_error_curve(read_bench_recording(path), nominal.ratio) for path in recordings]
    found = identify(curves, nominal, lambda step: print(f"   {step}"))
    write_identification(found, OUT / "identification.json")
    write_surface(found.surface, OUT / "identified.nc")

    print("4. The FMU of this very drive, simulated beside the measurement")
    build_fmu(nominal, OUT / "identified.fmu", read_surface(OUT / "identified.nc"))
    zero = found.bench["output_angle_offset"]
    simulated = [
        follow(OUT / "identified.fmu", c.input_angle, c.torque, ("transmission_error",))["transmission_error"] + zero
        for c in curves
    ]
    save(plot_comparison(curves, simulated, "simulated by the FMU"), OUT / "comparison.png")

    known = surface_of_pair(as_made)
    print_identification(found, {p.name: structured_value(as_made, known, p.name) for p in found.parameters})
    left = np.concatenate([c.transmission_error - s for c, s in zip(curves, simulated, strict=True)])
    print(f"FMU and measurement differ by {np.sqrt(np.mean(left**2)) / ARCSEC:.2f}″ rms; see {OUT / 'comparison.png'}")


if __name__ == "__main__":
    main()
