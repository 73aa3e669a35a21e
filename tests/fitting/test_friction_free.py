"""Play, stiffness and friction of loops whose friction grows with load, against simulated drives of known values."""

import dataclasses
import json
import math

import numpy as np
import pytest
from common import MEASURED, MOTOR_MAPPING, study_size

import fitting
import fitting.figures.metrics
from fitting.figures.friction_free import friction_free
from fitting.transmission_error.loops import LoopData, find_lobes, find_loops

STIFFNESS, PLAY = 300.0, math.radians(1.0)  # N·m/rad, rad


def moved(torque, friction, growth, slip=0.0, stiffness=STIFFNESS, play=PLAY):
    """Windup (rad) under a torque over time (N·m): play and spring, behind dry friction F = friction + growth |M|.

    The windup stays while the torque is within ± F of the spring's; with `slip` it then runs on to where the sliding
    friction, less by this share, holds it.
    """

    def reached(friction, growth):
        """Windup up to which each torque pushes it upwards."""
        beyond = np.maximum(torque - friction, 0.0) / (1.0 + growth)
        before = np.minimum(torque - friction, 0.0) / (1.0 - growth)
        return np.where(torque >= friction, beyond / stiffness + 0.5 * play, before / stiffness - 0.5 * play)

    up, up_to = reached(friction, growth), reached((1.0 - slip) * friction, (1.0 - slip) * growth)
    torque = -torque
    down, down_to = -reached(friction, growth), -reached((1.0 - slip) * friction, (1.0 - slip) * growth)
    found, at = np.empty(torque.size), 0.0
    for k in range(torque.size):
        if at < up[k]:
            at = up_to[k]
        elif at > down[k]:
            at = down_to[k]
        found[k] = at
    return found


@dataclasses.dataclass(frozen=True)
class Rig:
    """A rig and its drive: friction (N·m, 1), samples of a pass, noise (N·m, rad), drift (rad), counts of a turn."""

    friction: float = 2.5
    growth: float = 0.4
    slip: float = 0.0
    loops: int = 3
    samples: int = 700
    torque_noise: float = 0.0
    angle_noise: float = 0.0
    drift: float = 0.0
    counts: float = math.inf
    largest: float = 25.0

    def record(self, seed=0):
        """Time (s), torque (N·m) and windup (rad) of the loops."""
        draw, half = np.random.default_rng(seed).normal, self.samples // 2
        ends = [0.0, *[self.largest * (-1) ** k for k in range(2 * self.loops)], 0.0]
        lengths = [half, *[self.samples] * (2 * self.loops - 1), half]
        ramp = np.concatenate([np.linspace(a, b, n) for a, b, n in zip(ends[:-1], ends[1:], lengths, strict=True)])
        time = 0.016 * np.arange(ramp.size)
        windup = moved(ramp, self.friction, self.growth, self.slip) + self.drift * time / time[-1]
        windup = windup + draw(0.0, self.angle_noise, ramp.size)
        if math.isfinite(self.counts):
            windup = np.round(windup * self.counts / (2.0 * np.pi)) * 2.0 * np.pi / self.counts
        return time, ramp + draw(0.0, self.torque_noise, ramp.size), windup

    def loop_data(self, seed=0):
        time, torque, windup = self.record(seed)
        lobes = find_lobes(torque, self.largest)
        return LoopData(
            time, torque, windup - windup.mean(), tuple(find_loops(lobes)), tuple(lobes), self.largest, "rig"
        )

    def truth(self, at):
        """The figures, the efficiencies at a spring torque, N·m."""
        friction = self.friction + self.growth * at
        return {
            "play": PLAY,
            "torsional_stiffness": STIFFNESS,
            "friction_torque": self.friction,
            "friction_per_load": self.growth,
            "efficiency_driving": at / (at + friction),
            "efficiency_back_driving": max(1.0 - friction / at, 0.0),
        }


@pytest.mark.parametrize("growth", [0.0, 0.2, 0.4, 0.7])
def test_without_noise_the_figures_are_what_the_drive_was_made_of(growth):
    """The windup is left between two samples, whose torques differ by 0.07 N·m."""
    found = friction_free(Rig(growth=growth).loop_data())
    for name, value in Rig(growth=growth).truth(found.largest).items():
        one = found.figures[name]
        assert one.value == pytest.approx(value, rel=0.01, abs=0.005), name
        assert abs(one.value - value) <= one.uncertainty + 1e-12 * abs(value), name
        assert one.uncertainty < 0.05 * value + 0.05, name


def written(rig, folder):
    """The figures of a rig's recording as a drive's own motor logs it, with its mapping."""
    time, torque, windup = rig.record()
    table = np.column_stack([time, windup / (2.0 * np.pi), torque])
    np.savetxt(folder / "loop.csv", table, delimiter=",", header="TIME,POSITION,TORQUE", comments="")
    (folder / "m.toml").write_text(MOTOR_MAPPING)
    recording = fitting.read_recordings(folder / "loop.csv", folder / "m.toml")
    return fitting.metrics(recording, rated_torque=rig.largest)


def test_standard_figures_say_where_friction_grows_with_load(tmp_path):
    """Their definitions assume a constant friction: 420 N·m/rad, where the spring has 300."""
    found = written(Rig(), tmp_path)
    assert found.figures["torsional_stiffness"].value == pytest.approx(1.4 * STIFFNESS, rel=0.01)
    assert "1.40 times the stiffness" in found.figures["torsional_stiffness"].remark
    assert "friction_free.play" in found.figures["backlash"].remark
    assert found.friction_free["torsional_stiffness"].value == pytest.approx(STIFFNESS, rel=0.01)
    found = written(Rig(growth=0.0), tmp_path)
    assert not any(one.remark for one in found.figures.values())
    assert found.figures["backlash"].value == pytest.approx(found.friction_free["play"].value, rel=0.02)


def test_a_drive_that_locks_itself_has_no_efficiency_back():
    found = friction_free(Rig(friction=5.0, growth=0.95).loop_data())
    assert found.figures["efficiency_back_driving"].value == 0.0
    assert found.figures["play"].value == pytest.approx(PLAY, rel=0.05)


def test_play_on_one_side_of_zero_is_the_same_play():
    """Where the windup is zero does not count."""
    data = Rig().loop_data()
    found, other = (friction_free(dataclasses.replace(data, windup=data.windup + shift)) for shift in (0.0, 0.3))
    for name, one in found.figures.items():
        assert other.figures[name].value == pytest.approx(one.value, rel=1e-6)


def test_a_pass_in_one_direction_alone_has_no_mid_curve():
    data = Rig(loops=1).loop_data()
    half = data.lobes[0].loading
    part = dataclasses.replace(data, lobes=(dataclasses.replace(data.lobes[0], unloading=slice(half.stop, half.stop)),))
    assert friction_free(part) is None


@pytest.mark.slow(1)
def test_the_file_has_the_figures_in_si_and_the_table_shows_them(tmp_path, command):
    written(Rig(torque_noise=0.3), tmp_path)
    done = command("cycloid-fit", "metrics", "loop.csv", "--mapping", "m.toml", "-o", "figures.json", "--plot", "f.png")
    assert done.returncode == 0, done.stderr
    assert "friction_free.play" in done.stdout
    assert "torsional_stiffness: contains friction that grows with load" in done.stdout
    found = json.loads((tmp_path / "figures.json").read_text())
    assert "remark" in found["torsional_stiffness"]
    units = {
        "play": "rad",
        "torsional_stiffness": "N*m/rad",
        "friction_torque": "N*m",
        "friction_per_load": "1",
        "efficiency_driving": "1",
        "efficiency_back_driving": "1",
    }
    assert {name: one["unit"] for name, one in found["friction_free"].items()} == units
    assert found["friction_free"]["play"]["value"] == pytest.approx(PLAY, rel=0.05)


def test_loops_of_two_sizes_each_have_their_figures(tmp_path):
    """Five small loops and three large ones; the figures at the top are those of the large ones."""
    small, large = Rig(loops=5, largest=5.0, samples=140), Rig(torque_noise=0.1)
    parts = [rig.record() for rig in (small, large)]
    time = 0.016 * np.arange(sum(part[0].size for part in parts))
    table = np.column_stack([time, *(np.concatenate([part[k] for part in parts]) for k in (2, 1))])
    table[:, 1] /= 2.0 * np.pi
    np.savetxt(tmp_path / "loop.csv", table, delimiter=",", header="TIME,POSITION,TORQUE", comments="")
    (tmp_path / "m.toml").write_text(MOTOR_MAPPING)
    found = fitting.metrics(fitting.read_recordings(tmp_path / "loop.csv", tmp_path / "m.toml"))
    first, second = found.loop_groups
    assert first.largest_torque == pytest.approx(25.0, rel=0.02)
    assert second.largest_torque == pytest.approx(5.0, rel=0.02)
    assert (first.loops_found, first.loops_used) == (3, 3)
    assert (second.loops_found, second.loops_used) == (5, 5)
    # The unloading branches stand apart by the play and by what the friction holds: F = T at their beginning.
    held = (5.0 - 2.5) / 1.4
    assert second.figures["hysteresis_loss"].value == pytest.approx(PLAY + 2.0 * held / STIFFNESS, rel=0.03)
    stiffness = first.figures["loading_stiffness"]
    assert stiffness.interval == (10.0, 20.0)
    assert stiffness.value == pytest.approx(1.4 * STIFFNESS, rel=0.02)
    assert found.friction_free["play"].value == pytest.approx(PLAY, rel=0.03)
    written = json.loads(json.dumps(fitting.figures.metrics.figures_json(found)))["loop_groups"]
    assert [one["loops_found"] for one in written] == [3, 5]


PLAYS = (math.radians(0.8), math.radians(1.0), math.radians(1.3))


@pytest.mark.parametrize("stated", [True, False])
def test_each_position_has_its_play(stated):
    """The output is turned by 20° between loops; the play is given as a range, and the jumps are in no figure."""
    rig, parts = Rig(torque_noise=0.1), []
    for number, play in enumerate(PLAYS):
        _, torque, _ = rig.record(number)
        _, still, _ = dataclasses.replace(rig, torque_noise=0.0).record()
        parts.append(
            (torque, moved(still, 2.5, 0.4, play=play) + math.radians(20.0 * number), np.full(still.size, number))
        )
    torque, windup, group = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    run = fitting.Run(
        input_angle=0.0,
        output_angle=windup,
        torque=torque,
        time=0.016 * np.arange(torque.size),
        group=group if stated else None,
    )
    found = fitting.metrics(run, ratio=-13.0)
    by_place = sorted(found.loop_groups, key=lambda one: one.friction_free.figures["play"].value)
    assert [one.friction_free.figures["play"].value for one in by_place] == pytest.approx(PLAYS, rel=0.02)
    assert [one.loops_used for one in by_place] == [3, 3, 3]
    assert [one.group for one in by_place] == ([0.0, 1.0, 2.0] if stated else [None] * 3)
    smallest, largest = found.play_range
    assert (smallest.value, largest.value) == pytest.approx((PLAYS[0], PLAYS[2]), rel=0.02)
    assert found.friction_free["torsional_stiffness"].value == pytest.approx(STIFFNESS, rel=0.02)
    assert found.friction_free["play"].value == pytest.approx(np.mean(PLAYS), rel=0.02)
    assert not any("drift" in note or "implausible" in note for note in found.notes)


def test_a_column_states_the_groups(tmp_path, command):
    rig = Rig(torque_noise=0.1)
    loops = [rig.record(seed)[1:] for seed in range(2)]
    torque, windup = (np.concatenate(columns) for columns in zip(*loops, strict=True))
    group = np.repeat([10, 30], loops[0][0].size)
    table = np.column_stack([0.016 * np.arange(torque.size), windup / (2.0 * np.pi), torque, group])
    np.savetxt(tmp_path / "loop.csv", table, delimiter=",", header="TIME,POSITION,TORQUE,place", comments="")
    (tmp_path / "m.toml").write_text(f'{MOTOR_MAPPING}[group]\ncolumn = "place"\n')
    done = command("cycloid-fit", "metrics", "loop.csv", "--mapping", "m.toml", "--json")
    assert done.returncode == 0, done.stderr
    content = json.loads(done.stdout)
    assert sorted(one["group"] for one in content["loop_groups"]) == [10.0, 30.0]
    low, high = (one["value"] for one in content["play_range"])
    assert low <= high == pytest.approx(PLAY, rel=0.03)
    done = command("cycloid-fit", "metrics", "loop.csv", "--mapping", "m.toml")
    assert "Play over the positions of the loops, without friction:" in done.stdout
    (tmp_path / "m.toml").write_text(f'{MOTOR_MAPPING}[group]\ncolumn = "spot"\n')
    done = command("cycloid-fit", "metrics", "loop.csv", "--mapping", "m.toml")
    assert done.returncode == 2
    assert 'no column "spot" for group' in done.stderr


@pytest.mark.parametrize("ratio", [13.0, -13.0])
def test_torque_and_angle_of_the_motor_are_referred_to_the_output(tmp_path, ratio):
    """The same loop by a log of the motor, its torque as a current with a stated constant."""
    rig = Rig()
    time, torque, windup = rig.record()
    table = np.column_stack([time, windup * ratio / (2.0 * np.pi), torque / ratio / 0.08])
    np.savetxt(tmp_path / "motor.csv", table, delimiter=",", header="TIME,POSITION,CURRENT", comments="")
    motor = MOTOR_MAPPING.replace("[time]", f'ratio = {ratio:g}\nlocked = "output"\n[time]').replace(
        'unit = "rev"', 'unit = "rev"\nside = "motor"'
    )
    motor = motor.replace('column = "TORQUE"\nunit = "N*m"', 'column = "CURRENT"\nunit = "A"\nconstant = "0.08 N*m/A"')
    (tmp_path / "motor.toml").write_text(f'{motor}side = "motor"\n')
    found = fitting.metrics(fitting.read_recordings(tmp_path / "motor.csv", tmp_path / "motor.toml"))
    wanted = written(rig, tmp_path)
    for name, one in wanted.shown.items():
        assert found.shown[name].value == pytest.approx(one.value, rel=1e-6), name
    said = " ".join(found.notes)
    assert "output_angle, torque measured on the motor, referred to the output by the ratio" in said
    assert "the output is locked; the output angle is taken as the windup" in said


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (("[time]", '[time]\nside = "motor"'), "[time] side is not a known key"),
        (('unit = "rev"', 'unit = "rev"\nside = "motor"'), 'side = "motor" needs the ratio of the drive'),
        (('unit = "N*m"', 'unit = "N*m"\nconstant = "0.1 N*m/A"'), "TORQUE"),
        (('unit = "N*m"', 'unit = "A"\nconstant = "0 N*m/A"'), '[torque] constant = "0 N*m/A": it must not be 0'),
        (("[time]", 'locked = "motor"\n[time]'), "locked"),
    ],
)
def test_a_mapping_that_states_the_wrong_side_is_refused(tmp_path, command, change, sentence):
    written(Rig(), tmp_path)
    (tmp_path / "m.toml").write_text(MOTOR_MAPPING.replace(*change))
    done = command("cycloid-fit", "metrics", "loop.csv", "--mapping", "m.toml")
    assert done.returncode == 2
    assert sentence in done.stderr
    assert "Traceback" not in done.stderr


def test_a_locked_input_stands_still_while_the_output_winds_up(tmp_path):
    """Stated, its encoder is not taken for one that hangs."""
    time, torque, windup = Rig().record()
    table = np.column_stack([time, np.zeros(time.size), windup, torque])
    header = "time [s],input_angle [rad],output_angle [rad],torque [N*m]"
    np.savetxt(tmp_path / "loop.csv", table, delimiter=",", header=header, comments="")
    roles = "".join(f'[{n}]\ncolumn = "{n}"\n' for n in ("time", "input_angle", "output_angle", "torque"))
    (tmp_path / "m.toml").write_text(f'format = "cycloid-mapping/1"\nlocked = "input"\n{roles}')
    found = fitting.metrics(fitting.read_recordings(tmp_path / "loop.csv", tmp_path / "m.toml"), ratio=-13.0)
    assert found.friction_free["play"].value == pytest.approx(PLAY, rel=0.02)
    assert not any("implausible" in note for note in found.notes)


RIGS = {
    "constant friction": Rig(growth=0.0, torque_noise=0.3),
    "growing friction": Rig(torque_noise=0.3),
    "friction as large as the load": Rig(growth=0.7, torque_noise=0.3),
    "noise in the angle": Rig(angle_noise=3e-4),
    "noise in both": Rig(torque_noise=0.3, angle_noise=2e-4),
    "stick-slip": Rig(slip=0.2, torque_noise=0.3),
    "drift": Rig(drift=math.radians(0.3), torque_noise=0.3),
    "encoder of 12 bits": Rig(counts=13 * 4096, torque_noise=0.3),
    "one loop": Rig(loops=1, torque_noise=0.3),
    "two loops": Rig(loops=2, torque_noise=0.3),
    "eight loops": Rig(loops=8, torque_noise=0.3),
}


@pytest.mark.slow(1)
@pytest.mark.parametrize("kind", RIGS)
def test_intervals_hold(kind, record_property):
    """Nine of ten drives lie inside or more, and half of the intervals are below 15 % of the value."""
    rig, count = RIGS[kind], max(20, 5 * study_size("CYCLOID_SEEDS", 5, 40))
    inside, wide = dict.fromkeys(rig.truth(1.0), 0), {name: [] for name in rig.truth(1.0)}
    for seed in range(count):
        found = friction_free(rig.loop_data(seed))
        for name, value in rig.truth(found.largest).items():
            one = found.figures[name]
            inside[name] += abs(one.value - value) <= one.uncertainty
            wide[name].append(one.uncertainty / max(abs(value), 0.3))
    for name, hits in inside.items():
        record_property(f"{kind}: {name} inside its interval", f"{hits / count:.1%} of {count}")
        record_property(f"{kind}: {name}, median interval over the value", f"{np.median(wide[name]):.1%}")
        assert np.median(wide[name]) < 0.15, name
        assert hits / count > 0.95 - 3.0 * math.sqrt(0.05 * 0.95 / count) - 0.03, name


MOTOR = MOTOR_MAPPING.replace("[time]", 'ratio = 13\nlocked = "output"\n[time]').replace(
    'unit = "rev"', 'unit = "rev"\nside = "motor"'
)


@pytest.mark.measured_drives
@pytest.mark.parametrize(
    ("file", "mapping", "group", "wanted"),
    [
        ("onyx_init1_raw.csv.gz", MOTOR_MAPPING, 1, {"hysteresis_loss": (math.radians(1.256), math.radians(0.03))}),
        ("onyx_init1.csv", MOTOR_MAPPING, 1, {"hysteresis_loss": (math.radians(1.256), math.radians(0.02))}),
        ("june_motor_side.csv", f'{MOTOR}side = "motor"\n', 0, {"loading_stiffness": (653.0, 40.0)}),
        (
            "june_motor_side.csv",
            f'{MOTOR}side = "motor"\n',
            1,
            {"hysteresis_loss": (math.radians(2.09), math.radians(0.27))},
        ),
    ],
)
def test_groups_of_a_measured_drive(file, mapping, group, wanted, tmp_path):
    if not (MEASURED / file).exists():
        pytest.skip(f"{MEASURED / file} is missing")
    (tmp_path / "m.toml").write_text(mapping)
    found = fitting.metrics(fitting.read_recordings(MEASURED / file, tmp_path / "m.toml")).loop_groups[group]
    for name, (value, uncertainty) in wanted.items():
        assert abs(found.figures[name].value - value) < uncertainty, (name, found.figures[name].value)
    if file.startswith("onyx"):
        assert (found.loops_found, found.loops_used) == (5, 5)


MADE_OF = {
    "torsional_stiffness": (300.0, 15.0),
    "play": (math.radians(1.0), math.radians(0.1)),
    "friction_torque": (2.5, 0.3),
    "friction_per_load": (0.4, 0.04),
}


@pytest.mark.measured_drives
@pytest.mark.parametrize(
    ("file", "wanted"),
    [
        ("synthetic_motor_loop.csv", MADE_OF),
        ("conic_runin5.csv", {"torsional_stiffness": (202.0, 10.0), "friction_per_load": (0.68, 0.07)}),
    ],
)
def test_a_measured_drive(file, wanted, tmp_path):
    """Runs of a printed actuator with the output locked; the figures are of a second evaluation."""
    if not (MEASURED / file).exists():
        pytest.skip(f"{MEASURED / file} is missing")
    (tmp_path / "m.toml").write_text(MOTOR_MAPPING)
    found = fitting.metrics(fitting.read_recordings(MEASURED / file, tmp_path / "m.toml")).friction_free
    for name, (value, uncertainty) in wanted.items():
        assert abs(found[name].value - value) < uncertainty, (name, found[name].value)
