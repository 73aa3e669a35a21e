"""From a bench run to the FMU of that very drive
==============================================

A simulated bench replaces the real one: it turns the FMU of a drive with known errors and sends CANopen encoder frames
over a virtual CAN bus. All further steps are those for your own drive: record, make the transmission error curves,
identify the errors, write the error surface, build the FMU, simulate it, compare.
"""

from pathlib import Path

import numpy as np

import cycloid_fmu as cy
import drivers
import fitting

HERE, OUT = Path(__file__).parent, Path("bench_to_fmu_out")


def main() -> None:
    OUT.mkdir(exist_ok=True)

    print("1. The drive on the bench: an FMU of the drive as made")
    as_made = cy.read_drive(HERE / "drive-39-40-as-made.toml")
    as_made.build_fmu(OUT / "as-made.fmu")

    print("2. The bench runs at two loads in both directions, and the recorder writes the encoder samples")
    nominal = cy.read_drive(HERE / "drive-39-40.toml")
    recordings = []
    for load in (20.0, 200.0):
        for direction, sign in (("forward", 1.0), ("backward", -1.0)):  # a brake: the torque opposes the motion
            path = OUT / f"{load:g}Nm-{direction}.arrows"
            path.unlink(missing_ok=True)
            bench = drivers.simulate_bench(
                OUT / "as-made.fmu",
                ratio=nominal.pair.ratio,
                pair=nominal.pair.hash,
                torque=sign * load,
                turns=39,
                motion=drivers.SimulatedMotion(
                    48, direction, noise="0.5 arcsec", torque_noise=0.2, seed=len(recordings)
                ),
                bus="virtual",
            )
            with bench:
                done = bench.record(path, wiring=OUT / "bench.toml")
            print(f"   {path}: {min(done.samples.values())} samples per channel")
            recordings.append(path)

    print("3. Transmission error curves, and the errors behind them")
    found = fitting.identify(fitting.read_recordings(recordings), nominal, progress=lambda step: print(f"   {step}"))
    found.write(OUT / "identification.json")
    fitting.report(found, OUT / "identification.html")
    for one in found.parameters:
        if one.held is None and hasattr(as_made.surface, one.name):
            low, high, made = (1e6 * value for value in (*one.interval, getattr(as_made.surface, one.name)))
            print(f"   {one.name}: {low:.2f} … {high:.2f} µm; actual value {made:.2f} µm")

    print("4. The FMU of this drive, simulated and compared with the measurement")
    found.drive.write(OUT / "identified.nc")
    found.drive.build_fmu(OUT / "identified.fmu")
    zero = found.bench["output_angle_offset"]
    simulated = [
        cy.simulate_fmu(OUT / "identified.fmu", c.input_angle, c.torque)["transmission_error"] + zero
        for c in found.curves
    ]
    fitting.plot_comparison(found.curves, simulated, "simulated by the FMU").savefig(OUT / "comparison.png", dpi=150)
    left = np.concatenate([c.transmission_error - s for c, s in zip(found.curves, simulated, strict=True)])
    rms = np.sqrt(np.mean(left**2)) * cy.ARCSEC
    print(f"FMU and measurement differ by {rms:.2f}″ rms; see {OUT / 'comparison.png'}")


if __name__ == "__main__":
    main()
