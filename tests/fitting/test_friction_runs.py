"""Friction from ramps of speed and constant speeds, against simulated drives of known friction."""

import dataclasses
import json
import math

import numpy as np
import pytest
from common import MEASURED, MOTOR_MAPPING, study_size
from scipy.signal import lfilter

import cycloid_fmu as cy
import fitting
from cycloid_fmu import edge
from cycloid_fmu.fmu.friction_file import read_friction

COULOMB, VISCOUS = 3.5, 0.15  # N·m, N·m·s/rad
TURN = 2.0 * np.pi


def ramps(fastest, seconds, passes=4):
    """Speed (rad/s) over time (s) at 1 kHz: to the fastest and back in each direction in turn."""
    each = round(seconds * 1000)
    rise = np.linspace(0.0, fastest, each, endpoint=False)
    there = np.concatenate([rise, fastest - rise])
    speed = np.concatenate([there * (-1) ** k for k in range(passes // 2)])
    return np.arange(speed.size) / 1000.0, speed


@dataclasses.dataclass(frozen=True)
class Rig:
    """A drive that its motor turns; torque at the output.

    Friction (N·m, N·m·s/rad, rad/s, 1), inertia (kg·m²), load and zero of the sensor (N·m); ripple (N·m) at orders of
    the output, noise of a sample and noise correlated over 0.3 s (N·m), share of the friction that is lost while it
    warms up and the time constant of that over the recording's, step of the clock (s), counts of an output turn.
    """

    coulomb: float = COULOMB
    viscous: float = VISCOUS
    stribeck: float = 0.0
    stribeck_speed: float = 0.3
    growth: float = 0.0
    inertia: float = 0.2
    load: float = 0.0
    zero: float = -0.1
    ripple: float = 0.0
    noise: float = 0.0
    slow_noise: float = 0.0
    warming: float = 0.0
    warming_time: float = 0.3
    tick: float = 0.001
    counts: float = 13 * 4096
    fastest: float = TURN
    seconds: float = 12.5
    name: str = "ramp"

    def run(self, seed=0, motion=None):
        """A recording at 1 kHz, in ticks of the clock."""
        draw = np.random.default_rng(seed)
        time, speed = ramps(self.fastest, self.seconds) if motion is None else motion
        angle = np.cumsum(speed) / 1000.0 + draw.uniform(0.0, TURN)
        sign = np.sign(speed)
        sliding = self.coulomb + self.stribeck * np.exp(-((speed / self.stribeck_speed) ** 2))
        sliding = sliding * (1.0 + self.warming * np.exp(-time / (self.warming_time * time[-1])))
        torque = self.load + sign * self.under_load(sliding + self.viscous * np.abs(speed), sign) + self.zero
        torque = torque + self.inertia * np.gradient(speed, time)
        for order, share in ((1.0, 0.5), (13.0, 1.0), (14.0, 1.0), (26.0, 0.7)):
            rubbing, pushing = np.sin(order * angle[:, None] + draw.uniform(0.0, TURN, 2)).T * share * self.ripple
            torque = torque + 0.7 * (np.sign(speed) * rubbing + pushing)
        torque = torque + draw.normal(0.0, self.noise, time.size)
        if self.slow_noise:
            steps, white = math.exp(-0.001 / 0.3), draw.normal(0.0, 1.0, time.size)
            torque = torque + self.slow_noise * math.sqrt(1.0 - steps**2) * lfilter([1.0], [1.0, -steps], white)
        seen = np.round(angle * self.counts / TURN) * TURN / self.counts
        return fitting.Run(
            input_angle=0.0,
            output_angle=seen,
            torque=torque,
            time=np.floor(time / self.tick + 1e-9) * self.tick,
            name=self.name,
        )

    def under_load(self, free, sign):
        """Friction F from that without load: F = (1 - mu) free + mu |load ± F|, driven by the motor or by the load."""
        own, pushing = (1.0 - self.growth) * free, self.growth * sign * self.load
        drives = (own + pushing) / (1.0 - self.growth)
        return np.where(sign * self.load + drives >= 0.0, drives, (own - pushing) / (1.0 + self.growth))

    @property
    def truth(self):
        return {"coulomb": self.coulomb, "viscous": self.viscous, "inertia": self.inertia, "offset": self.zero}


RIPPLE = {"noise": 0.3, "ripple": 0.1}


def inside(found, truth):
    """Whether each value lies within 1.5 times its interval, which a fixed seed may not miss by chance."""
    for name, value in truth.items():
        one = found.figures[name]
        assert abs(one.value - value) <= 1.5 * one.uncertainty, (name, one.value, one.uncertainty)


def test_without_noise_the_figures_are_what_the_drive_was_made_of():
    found = fitting.friction(Rig().run(), speeds=("0.1 rev/s", "1 rev/s"))
    for name, value in Rig().truth.items():
        assert found.figures[name].value == pytest.approx(value, rel=2e-3, abs=2e-3), name
    assert found.figures["coulomb_forward"].value == pytest.approx(COULOMB - 0.1, rel=2e-3)
    assert found.figures["coulomb_backward"].value == pytest.approx(COULOMB + 0.1, rel=2e-3)
    assert found.speeds == pytest.approx((0.1 * TURN, TURN))
    assert not {"stribeck", "stribeck_speed", "friction_per_load"} & set(found.figures)


def test_a_coarse_clock_gives_the_same_speed():
    """Six samples to a tick of 15.6 ms: the speed is the slope over many ticks."""
    fine, coarse = (fitting.friction(Rig(tick=tick).run(), speeds=(1.0, 6.0)).figures for tick in (0.001, 0.0156))
    assert coarse["viscous"].value == pytest.approx(fine["viscous"].value, rel=0.01)
    assert coarse["coulomb"].value == pytest.approx(fine["coulomb"].value, rel=0.002)


@pytest.mark.parametrize("speed", [0.3, 0.5])
def test_a_rise_towards_rest_is_a_stribeck_term(speed):
    found = fitting.friction(Rig(stribeck=1.0, stribeck_speed=speed, **RIPPLE).run(2))
    inside(found, {"coulomb": COULOMB, "viscous": VISCOUS, "stribeck": 1.0, "stribeck_speed": speed})
    assert found.figures["stribeck_speed"].uncertainty < 0.5 * speed
    without = fitting.friction(Rig(**RIPPLE).run(2))
    assert "stribeck" not in without.figures
    assert any("No Stribeck" in note for note in without.notes)


def test_several_loads_show_the_growth_of_the_friction():
    """A single torque drives: the load is the mean of both directions, without being stated."""
    loads = (0.0, 20.0, -20.0, 40.0)
    rigs = [Rig(growth=0.1, load=load, name=f"at {load}", **RIPPLE) for load in loads]
    found = fitting.friction([rig.run(k) for k, rig in enumerate(rigs)])
    inside(found, {"coulomb": COULOMB, "viscous": VISCOUS, "friction_per_load": 0.1})
    assert list(found.loads.values()) == pytest.approx([load - 0.1 for load in loads], abs=0.2)
    assert "coulomb_forward" not in found.figures
    constant = fitting.friction([dataclasses.replace(rig, growth=0.0).run(k) for k, rig in enumerate(rigs)])
    assert "friction_per_load" not in constant.figures
    assert any("not resolved" in note for note in constant.notes)


def test_torques_on_both_shafts_are_the_same_drive():
    """Power balance: the brake's torque and the motor's, referred by the ratio, differ by the friction."""
    runs = []
    for k, load in enumerate((0.0, 20.0, -40.0)):
        run = Rig(growth=0.1, load=load, name=f"at {load}", **RIPPLE).run(k)
        brake = np.full(run.torque.size, -load)
        runs.append(dataclasses.replace(run, torque=brake, input_torque=run.torque / -13.0))
    found = fitting.friction(runs, ratio=-13.0)
    inside(found, {"coulomb": COULOMB, "viscous": VISCOUS, "friction_per_load": 0.1})
    assert list(found.loads.values()) == pytest.approx([0.0, 20.0, -40.0])
    with pytest.raises(edge.InputError, match="referred to the output by the ratio"):
        fitting.friction(runs)


def at_constant_speed(speed, seed, scatter=0.05):
    """Three seconds at a speed, rad/s, with a friction of its own."""
    own = np.random.default_rng(1000 + seed).normal(0.0, scatter)
    rig = Rig(coulomb=COULOMB + own, name=f"{speed} rad/s", **RIPPLE)
    return rig.run(seed, (np.arange(3000) / 1000.0, np.full(3000, speed)))


def test_what_differs_between_runs_at_constant_speeds_counts():
    """What differs from run to run, although each is quiet, is in the interval."""
    speeds = [-6.0, -5.0, -4.0, -3.0, -2.0, -1.0, -0.5, 0.5, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0]
    found = fitting.friction([at_constant_speed(speed, k) for k, speed in enumerate(speeds)])
    inside(found, {"coulomb": COULOMB, "viscous": VISCOUS})
    assert found.figures["coulomb"].uncertainty > 0.05 / math.sqrt(len(speeds))


def test_what_the_recordings_do_not_resolve_is_not_reported(tmp_path):
    found = fitting.friction([at_constant_speed(speed, k) for k, speed in enumerate((2.0, -2.0))])
    assert "viscous" not in found.figures
    assert found.figures["coulomb"].value == pytest.approx(COULOMB + 2.0 * VISCOUS, abs=0.15)
    assert "at this speed" in found.figures["coulomb"].remark
    forward = fitting.friction([at_constant_speed(speed, k) for k, speed in enumerate((1.0, 2.0, 3.0, 4.0))])
    assert set(forward.figures) == {"coulomb_forward", "viscous"}
    assert any("only one direction" in note for note in forward.notes)
    with pytest.raises(edge.NoDataError, match="record both"):
        forward.write(tmp_path / "friction.toml")


def test_ramps_up_alone_leave_the_inertia_in_the_friction():
    time, speed = ramps(TURN, 12.5, 2)
    rise = speed[: speed.size // 2]
    run = Rig(**RIPPLE).run(5, (time, np.concatenate([rise, -rise])))
    found = fitting.friction(run)
    assert "inertia" not in found.figures
    assert "0.5 N·m for each kg·m² at the output" in found.figures["coulomb"].remark


def test_friction_that_falls_while_it_warms_up_is_said():
    found = fitting.friction(Rig(warming=0.5, warming_time=3.0, noise=0.1).run(1, ramps(TURN, 3.0, 16)))
    assert any("drifts by -" in note for note in found.notes)


def test_a_curve_that_is_no_line_is_said():
    rig = Rig(noise=0.1, viscous=0.0)
    run = rig.run(1)
    speed = np.gradient(run.output_angle, run.time)
    bent = dataclasses.replace(run, torque=run.torque + 0.8 * np.sign(speed) * np.sqrt(np.abs(speed)))
    assert any("slope falls with the speed" in note for note in fitting.friction(bent, speeds=(1.0, 6.0)).notes)


def test_invalid_input_is_refused_in_a_sentence():
    run = Rig(**RIPPLE).run()
    with pytest.raises(edge.NoDataError, match="the torque opposes the motion"):
        fitting.friction(dataclasses.replace(run, torque=-run.torque))
    with pytest.raises(edge.NoDataError, match="does not turn"):
        fitting.friction(dataclasses.replace(run, output_angle=np.zeros(run.time.size)))
    with pytest.raises(edge.InputError, match="needs times"):
        fitting.friction(dataclasses.replace(run, time=None))
    for speeds in ((2.0, 1.0), (1.0,), ("1 N*m", "2 N*m")):
        with pytest.raises(edge.ArgumentError, match="speeds"):
            fitting.friction(run, speeds=speeds)


def test_starts_from_rest_give_the_starting_torque():
    """A ramp of the torque on the input, which breaks away at 0.4 N·m; nothing else turns for long."""
    time = np.arange(4000) / 1000.0
    torque = np.minimum(0.2 * time, 0.4)
    crank = np.where(time > 2.0, (time - 2.0) * 0.3, 0.0)
    run = fitting.Run(input_angle=crank, output_angle=crank / -39.0, torque=0.0, input_torque=torque, time=time)
    found = fitting.friction(run, ratio=-39.0, speeds=(1.0, 2.0))
    assert found.figures["starting_torque"].value == pytest.approx(0.4, abs=0.01)
    assert "coulomb" not in found.figures
    assert any("too briefly" in note for note in found.notes)


@pytest.mark.slow(2)
def test_measured_friction_is_the_friction_of_the_fmu(tmp_path, command, nominal):
    """Recording, friction file, FMU and a recording of its flanges: the same friction again, at every load."""
    rigs = [Rig(growth=0.1, load=load, name=f"at {load}", **RIPPLE) for load in (0.0, 20.0, 40.0)]
    measured = fitting.friction([rig.run(k) for k, rig in enumerate(rigs)])
    measured.write(tmp_path / "friction.toml")
    stated = read_friction(tmp_path / "friction.toml").output
    cy.Drive(nominal).write(tmp_path / "drive.toml")
    done = command("cycloid-fmu", "build", "drive.toml", "--friction", "friction.toml", "-o", "drive.fmu")
    assert done.returncode == 0, done.stderr
    runs, ratio = [], cy.Drive(nominal).ratio
    for load in (0.0, -20.0, -60.0):
        for speed in (1.0, 4.0, -1.0, -4.0):
            time = np.arange(2000) / 1000.0
            crank = ratio * speed * time
            simulated = cy.simulate_fmu(
                tmp_path / "drive.fmu", crank, load, ("flange_b.phi", "flange_a.tau"), crank_speed=ratio * speed
            )
            begun = slice(200, None)
            runs.append(
                fitting.Run(
                    input_angle=crank[begun],
                    output_angle=simulated["flange_b.phi"][begun],
                    torque=load,
                    input_torque=simulated["flange_a.tau"][begun],
                    time=time[begun],
                    name=f"{load} N·m, {speed} rad/s",
                )
            )
    again = fitting.friction(runs, ratio=ratio).figures
    for name in ("coulomb", "viscous"):
        assert again[name].value == pytest.approx(measured.figures[name].value, rel=0.01)
    assert again["friction_per_load"].value == pytest.approx(stated.load_share, rel=0.02)


def test_the_command_writes_the_friction_file_with_the_growth_of_loops(tmp_path, command):
    run = Rig(**RIPPLE).run()
    table = np.column_stack([run.time, run.output_angle / TURN, run.torque])
    np.savetxt(tmp_path / "ramp.csv", table, delimiter=",", header="TIME,POSITION,TORQUE", comments="")
    (tmp_path / "m.toml").write_text(MOTOR_MAPPING)
    growth = {"value": 0.4, "uncertainty": 0.02, "unit": "1", "definition": "mu", "passes": 6}
    figures = {"format": "cycloid-figures/1", "friction_free": {"friction_per_load": growth}}
    (tmp_path / "figures.json").write_text(json.dumps(figures))
    words = ("cycloid-fit", "friction", "ramp.csv", "--mapping", "m.toml", "--speeds", "0.1 rev/s, 1 rev/s")
    done = command(*words, "--loop", "figures.json", "-o", "friction.toml", "--plot", "f.png", "--json")
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert found["format"] == "cycloid-friction-fit/1"
    assert found["coulomb"]["value"] == pytest.approx(COULOMB, abs=0.1)
    assert found["speeds"] == pytest.approx([0.1 * TURN, TURN])
    stated = read_friction(tmp_path / "friction.toml").output
    assert stated.load_share == 0.4
    for name in ("coulomb", "viscous"):  # without load the teeth carry the friction itself
        assert getattr(stated, name) / (1.0 - 0.4) == pytest.approx(found[name]["value"], rel=1e-5)
    # Of a loop with the output locked, the motor's torque on the teeth, M + F, has the friction in it.
    (tmp_path / "figures.json").write_text(json.dumps(figures | {"locked": {"loop.csv": "output"}}))
    done = command(*words, "--loop", "figures.json", "-o", "friction.toml", "--json")
    law, coulomb = read_friction(tmp_path / "friction.toml").output, json.loads(done.stdout)["coulomb"]["value"]
    spring = 20.0
    driven = spring + coulomb + 0.4 * spring
    assert driven == pytest.approx(spring + law.coulomb + law.load_share * driven, rel=1e-4)
    done = command(*words)
    assert done.returncode == 0
    assert "viscous" in done.stdout
    assert "N·m·s/rad" in done.stdout
    none = json.dumps({"format": figures["format"]})
    for content, said in (("{", "figures.json"), ("{}", "format"), (none, "friction_per_load is missing")):
        (tmp_path / "figures.json").write_text(content)
        done = command(*words, "--loop", "figures.json")
        assert done.returncode == 2
        assert "figures.json" in done.stderr
        assert said in done.stderr
        assert len(done.stderr.splitlines()) < 3
    (tmp_path / "angle.toml").write_text(MOTOR_MAPPING[: MOTOR_MAPPING.index("[torque]")])
    done = command(*words[:3], "--mapping", "angle.toml")
    assert done.returncode == 2
    assert "no torque is mapped" in done.stderr
    done = command(*words[:5], "--speeds", "1 rev/s")
    assert done.returncode == 2
    assert "--speeds" in done.stderr


RIGS = {
    "noise": [Rig(noise=1.3)],
    "ripple": [Rig(noise=0.5, ripple=0.5)],
    "ripple above the noise": [Rig(noise=0.1, ripple=1.0)],
    "slow noise": [Rig(noise=0.5, slow_noise=0.5)],
    "warming up by a tenth": [Rig(noise=0.5, ripple=0.3, warming=0.1)],
    "ticks": [Rig(noise=1.3, ripple=0.3, tick=0.0156)],
    "encoder of 12 bits on the output": [Rig(noise=0.5, ripple=0.3, counts=4096)],
    "short": [Rig(noise=1.0, ripple=0.3, seconds=3.0)],
    "Stribeck": [Rig(noise=0.5, ripple=0.2, stribeck=1.5, stribeck_speed=0.5)],
    "loads": [Rig(noise=0.5, ripple=0.3, growth=0.1, load=load, name=f"{load}") for load in (0.0, 15.0, 30.0)],
}


@pytest.mark.slow(2)
@pytest.mark.parametrize("kind", RIGS)
def test_intervals_hold(kind, record_property):
    """Of simulated drives nine of ten lie inside or more, and intervals are not far wider than the errors."""
    rigs, count = RIGS[kind], max(20, 4 * study_size("CYCLOID_SEEDS", 5, 40))
    speeds = None if kind == "Stribeck" else ("0.1 rev/s", "1 rev/s")
    rig = rigs[0]
    warm = 1.0 + rig.warming * 0.3 * (1.0 - math.exp(-1.0 / 0.3))  # the mean over the recording
    truth = {"coulomb": rig.coulomb * warm, "viscous": rig.viscous, "inertia": rig.inertia}
    if kind == "Stribeck":
        truth |= {"stribeck": rig.stribeck, "stribeck_speed": rig.stribeck_speed}
    if kind == "loads":
        truth["friction_per_load"] = rig.growth
    errors, widths = ({name: [] for name in truth} for _ in range(2))
    for seed in range(count):
        found = fitting.friction([one.run(100 * seed + k) for k, one in enumerate(rigs)], speeds=speeds).figures
        for name in truth.keys() & found.keys():
            errors[name].append(found[name].value - truth[name])
            widths[name].append(found[name].uncertainty)
    for name, value in truth.items():
        error, width = np.array(errors[name]), np.array(widths[name])
        if name == "inertia" and error.size < 0.5 * count:  # it is reported only where it is resolved
            continue
        share = float((np.abs(error) <= width).mean())
        record_property(f"{kind}: {name} inside its interval", f"{share:.1%} of {error.size}")
        record_property(f"{kind}: {name}, median interval", f"{np.median(width) / value:.1%} of the value")
        if name != "inertia":
            assert error.size > 0.9 * count, name
            assert np.median(width) < 4.0 * math.sqrt(float((error**2).mean())) + 0.01, name
        assert share > 0.95 - 3.0 * math.sqrt(0.05 * 0.95 / error.size) - 0.03, name


@pytest.mark.measured_drives
@pytest.mark.parametrize(
    ("speeds", "coulomb", "viscous"),
    [
        (("0.1 rev/s", "1 rev/s"), (3.556, 0.165), (0.146, 0.043)),
        (("0.1 rev/s", "0.45 rev/s"), (3.43, 0.313), (0.207, 0.151)),
    ],
)
def test_a_measured_drive(speeds, coulomb, viscous, tmp_path):
    """A printed actuator's ramp of speed from its own motor; the figures are of a second evaluation."""
    file = MEASURED / "speedramp_onyx_topspeed.csv"
    if not file.exists():
        pytest.skip(f"{file} is missing")
    (tmp_path / "m.toml").write_text(MOTOR_MAPPING)
    found = fitting.friction(fitting.read_recordings(file, tmp_path / "m.toml"), speeds=speeds).figures
    for name, (value, uncertainty) in (("coulomb", coulomb), ("viscous", viscous)):
        assert abs(found[name].value - value) < min(uncertainty, found[name].uncertainty), name
        assert 0.4 * uncertainty < found[name].uncertainty < 2.0 * uncertainty, name
