"""A compensated joint
===================

Record, identify, compensate, verify: a compensator is made from a bench run of one drive. A motor that follows it moves
the output to the desired angle, without an output encoder. A simulated bench and a simulated joint replace the real
ones; both are FMUs of a drive with errors that the rest of the script does not know.
"""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

import cycloid_fmu as cy
import drivers
import fitting
from cycloid_fmu.compensation.compensator import Compensator
from cycloid_fmu.compensation.index import find_index

HERE, OUT = Path(__file__).parent, Path("compensated_joint_out")
Array = NDArray[np.float64]
AMBIENT = 293.15  # K
FRICTION = cy.Friction(coulomb="2 N*m", load_share=0.01)
INDEX = 1.9  # rad of the crank: zero of the joint's encoders
ARM, WEIGHT = 2.0, 120.0  # kg·m², N·m
SECONDS, MOVES = 1.5, (0.9, 0.2, 1.2, -0.1, 0.0)  # s for each move, rad at its end
STEP = 2e-3  # s


def recorded(joint: Path, nominal: cy.Drive) -> list[Path]:
    """Record the drive on the bench at two loads in both directions."""
    recordings = []
    for load in (20.0, 200.0):
        for direction, sign in (("forward", 1.0), ("backward", -1.0)):
            path = OUT / f"{load:g}Nm-{direction}.arrows"
            path.unlink(missing_ok=True)
            bench = drivers.simulate_bench(
                joint,
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
                bench.record(path, wiring=OUT / "bench.toml")
            recordings.append(path)
    return recordings


def profile() -> tuple[Array, Array, Array, Array]:
    """Times of a robot's moves with a stop after each, and the desired angle, speed and acceleration."""
    begin, parts, s = 0.0, [], np.linspace(0.0, 1.0, round(SECONDS / STEP), endpoint=False)
    for end in MOVES:
        way = end - begin
        parts.append(
            [
                begin + way * s**3 * (10.0 - 15.0 * s + 6.0 * s**2),
                way * 30.0 * (s * (1.0 - s)) ** 2 / SECONDS,
                way * 60.0 * s * (1.0 - s) * (1.0 - 2.0 * s) / SECONDS**2,
            ]
        )
        begin = end
    angle, speed, acceleration = np.concatenate(parts, axis=1)
    return STEP * np.arange(angle.size), angle, speed, acceleration


def output(joint: Path, motor_angle: Array, load: Array, ratio: float) -> Array:
    """The actual output angle from the joint's FMU, whose crank is at the index when its encoders show zero."""
    found = cy.simulate_fmu(joint, crank_angle=motor_angle + INDEX, torque=load)
    return motor_angle / ratio + found["transmission_error"]


def searched(compensator: Compensator, joint: Path, ratio: float, random: np.random.Generator) -> float:
    """Find the index with a temporary output encoder during commissioning: four crank turns under the weight."""
    motor = np.linspace(0.0, 8.0 * np.pi, 800)
    load = np.full(motor.size, WEIGHT)
    shown = output(joint, motor, load, ratio) + random.normal(0.0, 1.0, motor.size) / cy.ARCSEC
    found = find_index(compensator, motor, shown, load, AMBIENT)
    print(
        f"   index at {found.angle:.3f} rad of the crank (true: {INDEX}, modulo turns of the gear), probability "
        f"{found.probability:.4f}; residual {found.residual * cy.ARCSEC:.1f}″"
    )
    return found.angle


def main() -> None:
    OUT.mkdir(exist_ok=True)
    random = np.random.default_rng(7)
    nominal, as_made = cy.read_drive(HERE / "drive-39-40.toml"), cy.read_drive(HERE / "drive-39-40-as-made.toml")
    as_made.build_fmu(OUT / "bench.fmu")
    as_made.build_fmu(OUT / "joint.fmu", cy.Interface(output_friction=FRICTION))

    print("1. Record and identify")
    runs = fitting.read_recordings(recorded(OUT / "bench.fmu", nominal))
    identified = fitting.identify(runs, nominal)
    print(f"   {identified.verdict.sentence}")

    print("2. The compensator of this drive")
    compensator = identified.drive.compensator(friction=FRICTION)
    largest = compensator.inverse.residual * cy.ARCSEC
    print(f"   {compensator.size / 1e3:.0f} kB of tables with errors of at most {largest:.2f}″")
    index = searched(compensator, OUT / "joint.fmu", nominal.ratio, random)

    print("3. The joint moves, with and without compensation")
    time, angle, speed, acceleration = profile()
    load = WEIGHT * np.cos(3.0 * angle) - ARM * acceleration
    # The controller's value of the load, with a gain error of 2 % and noise.
    stated = 1.02 * load + random.normal(0.0, 0.5, load.size)
    memory = compensator.start(index)
    commands = [compensator.step(memory, *now, AMBIENT) for now in zip(angle, speed, stated, strict=True)]
    motor = np.array([command.motor_angle for command in commands])
    band = np.array([command.band for command in commands]) * cy.ARCSEC
    errors = {
        "motor at ratio times the desired angle": output(OUT / "joint.fmu", nominal.ratio * angle, load, nominal.ratio),
        "compensated": output(OUT / "joint.fmu", motor, load, nominal.ratio),
    }
    left = {name: (found - angle) * cy.ARCSEC for name, found in errors.items()}
    plain, compensated = (float(np.sqrt(np.mean(off**2))) for off in left.values())
    less = 100.0 * (compensated / plain - 1.0)
    print(f"   error of the output {plain:.1f}″ rms, compensated {compensated:.1f}″: {less:.1f} %")

    figure = Figure(figsize=(9.0, 8.0), layout="constrained")
    axes = figure.subplots(3, sharex=True)
    axes[0].plot(time, np.degrees(angle))
    axes[0].set(
        ylabel="desired output angle [°]", title=f"Compensated joint: {plain:.0f}″ rms reduced to {compensated:.1f}″"
    )
    load_axis = axes[0].twinx()
    load_axis.plot(time, load, color="C3", lw=1.0)
    load_axis.set_ylabel("load [N·m]", color="C3")
    for color, (name, off) in zip(("0.6", "C0"), left.items(), strict=True):
        axes[1].plot(time, off, color=color, lw=1.0, label=name)
    axes[1].set(ylabel="output angle − desired [arcsec]")
    axes[1].legend(fontsize="small", loc="lower right", bbox_to_anchor=(1.0, 1.0), ncol=2, frameon=False)
    axes[2].plot(time, left["compensated"], color="C0", lw=0.8, label="compensated")
    axes[2].fill_between(time, -2.0 * band, 2.0 * band, color="C0", alpha=0.2, lw=0.0, label="twice its band")
    axes[2].set(xlabel="time [s]", ylabel="the same, enlarged [arcsec]", ylim=(-5.0, 5.0))
    axes[2].legend(fontsize="small")
    for axis in axes:
        axis.grid(alpha=0.3)
    figure.savefig(OUT / "compensated_joint.png", dpi=150)
    print(f"See {OUT / 'compensated_joint.png'}.")


if __name__ == "__main__":
    main()
