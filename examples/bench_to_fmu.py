"""From a bench run to the FMU of that very drive
==============================================

A simulated bench stands in for the real one: it turns the FMU of a drive with known errors and sends CANopen encoder
frames over a virtual CAN bus. From there on everything is what you would do with your own drive: record, make the
transmission error curves, identify the errors, write the error surface, build the FMU, simulate it, compare.
"""

from pathlib import Path

import numpy as np

import drivers
from cycloid_fmu.draw.plots import save
from cycloid_fmu.fmu.build import build_fmu
from cycloid_fmu.fmu.run import follow
from cycloid_fmu.geometry.pair import read_pair
from cycloid_fmu.surfaces.files import read_surface, write_surface
from cycloid_fmu.surfaces.structured import structured_value
from cycloid_fmu.surfaces.surface import surface_of_pair
from fitting.cli import print_identification
from fitting.estimation.identify import identify
from fitting.estimation.result import write_identification
from fitting.recordings.recording import open_recording
from fitting.reports.plots import plot_comparison
from fitting.transmission_error.folding import transmission_error_curves

HERE, OUT = Path(__file__).parent, Path("bench_to_fmu_out")
ARCSEC = np.pi / 648000


def main() -> None:
    OUT.mkdir(exist_ok=True)

    print("1. The drive on the bench: an FMU of the drive as it was really made")
    as_made = read_pair(HERE / "drive-39-40-as-made.toml")
    build_fmu(as_made, OUT / "as-made.fmu")

    print("2. The bench runs at two loads in both directions, and the recorder writes what its encoders send")
    recordings = []
    for load in (20.0, 200.0):
        for direction, sign in (("forward", 1.0), ("backward", -1.0)):  # a brake: the torque opposes the motion
            path = OUT / f"{load:g}Nm-{direction}.arrows"
            path.unlink(missing_ok=True)
            bench = drivers.simulate_bench(
                OUT / "as-made.fmu", ratio=as_made.ratio, torque=sign * load, direction=direction, turns=39,
                samples_per_turn=48, noise="0.5 arcsec", torque_noise=0.2, seed=len(recordings), interface="virtual",
            )  # fmt: skip
            with bench:
                done = bench.record(path, wiring=OUT / "bench.toml")
            print(f"   {path}: {min(done.samples.values())} samples a channel")
            recordings.append(path)

    print("3. Transmission error curves, and the errors behind them")
    nominal = read_pair(HERE / "drive-39-40.toml")
    curves = [transmission_error_curves(open_recording(path).read(), nominal.ratio)[0] for path in recordings]
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
