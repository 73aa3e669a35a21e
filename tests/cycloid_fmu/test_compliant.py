"""The drive between two flanges: energy, damping, friction, losses and the inertia inside; FMI apart."""

import itertools
import math
from pathlib import Path

import numpy as np
import pytest
from clockworks import compliant_drive, kinematic_drive, torques_of_energy
from common import PAIR, study_size
from hypothesis import given, settings
from hypothesis import strategies as st

from cycloid_fmu import edge
from cycloid_fmu.analysis import solve
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.fmu.build import read_losses
from cycloid_fmu.fmu.clockwork import StepError
from cycloid_fmu.fmu.constants import LARGEST_TRANSMISSION_ERROR, OUTPUT_PRESLIDING_ANGLE
from cycloid_fmu.geometry.pair import parse_pair
from cycloid_fmu.surfaces.surface import nominal_surface

PLAY = parse_pair(
    PAIR + '[modification]\noffset = "-40 um"\nisometric = "-15 um"\n[errors]\ncentre_distance_x = "4 um"\n', "p"
)
SURFACE = nominal_surface(PLAY)
HALF = 1.8e-4  # rad, more than half of the play
STEPS = study_size("CYCLOID_STEPS", 1e4, 1e6)


def compliant(inertia=0.0, losses=((0.0, 1.0, 1.0, 0.0, 0.0),), **parameters):
    model = compliant_drive(DriveValue(PLAY, SURFACE), losses, inertia)
    for name, value in parameters.items():
        setattr(model, name, value)
    return model


def put(model, crank, deviation, crank_speed=0.0, deviation_speed=0.0):
    model.crank_angle, model.crank_speed = crank, crank_speed
    model.output_angle = crank / PLAY.ratio + deviation
    model.output_speed = crank_speed / PLAY.ratio + deviation_speed


def struck(model, inertia, speed):
    """Give an inertia at rest a speed (rad/s) by a blow of a nanosecond."""
    load = model.torque
    model.torque = load + inertia * speed / 1e-9
    model.advance(1e-9)
    assert model.output_speed == pytest.approx(speed, rel=1e-6)
    model.torque = load


class Work:
    """Work of the environment on a model that is moved along straight lines, by the trapezoidal rule.

    `unknown` bounds the error of the rule where torques are monotonic over each part.
    """

    def __init__(self, model, crank=0.0, deviation=0.0):
        self.model, self.place = model, (crank, deviation)
        put(model, crank, deviation)
        model.forget_history()
        model.advance()
        self.done = self.throughput = self.unknown = 0.0
        self.stored = model.elastic_energy

    def lead(self, crank, deviation, parts=1, step=1e-3):
        model = self.model
        way = np.subtract((crank, deviation), self.place) / parts
        for _ in range(parts):
            put(model, *self.place, *(way * parts / step))
            before = model.crank_torque, model.torque
            model.advance(step / parts)
            turned = way[0], way[0] / PLAY.ratio + way[1]
            torques = list(zip(before, (model.crank_torque, model.torque), turned, strict=True))
            work = [0.5 * (a + b) * w for a, b, w in torques]
            self.unknown += sum(0.5 * abs((b - a) * w) for a, b, w in torques)
            self.done += sum(work)
            self.throughput += sum(map(abs, work))
            self.place = tuple(np.add(self.place, way))
        return self

    @property
    def taken(self):
        """Energy that the drive has received and does not store."""
        return self.done - (self.model.elastic_energy - self.stored)


@pytest.mark.parametrize("compliance", [0.0, 1e-6])
@pytest.mark.parametrize("backlash_on", [True, False])
def test_both_torques_are_derivatives_of_the_stored_energy(compliance, backlash_on):
    model = compliant(series_compliance=compliance, backlash_on=backlash_on)
    for crank, deviation in ((0.3, 2.3e-4), (2.0, -2.6e-4), (5.5, 3.1e-4)):
        by_crank, by_output = torques_of_energy(model, crank, crank / PLAY.ratio + deviation)
        assert abs(model.torque) > 10.0
        assert model.crank_torque == pytest.approx(by_crank, rel=1e-5)
        assert model.torque == pytest.approx(by_output, rel=1e-5)


def test_it_is_the_quasi_static_drive_seen_from_both_flanges():
    """The energy's torque and the balance of F L differ by the term of moving curvature, up to 2e-3."""
    model, driven = compliant(), kinematic_drive(DriveValue(PLAY, SURFACE))
    for crank, torque in ((0.4, 100.0), (3.0, -60.0), (40.0, 150.0)):
        driven.crank_angle, driven.torque = crank, torque
        driven.advance()
        put(model, crank, driven.transmission_error)
        assert model.torque == pytest.approx(torque, rel=3e-3)
        assert model.crank_torque == pytest.approx(driven.crank_torque, rel=3e-3)
        assert model.backlash == pytest.approx(driven.backlash, abs=1e-12)
        assert model.contact_count == driven.contact_count


def test_inside_the_play_nothing_touches():
    model = compliant(mesh_damping=50.0)
    put(model, 0.7, 0.0, 10.0, 0.5)
    assert (model.torque, model.crank_torque, model.elastic_energy, model.power_loss) == (0.0, 0.0, 0.0, 0.0)


@settings(max_examples=15)
@given(st.lists(st.tuples(st.floats(-1.0, 1.0), st.floats(-3e-4, 3e-4)), min_size=2, max_size=4))
def test_a_closed_cycle_gives_nothing_back(corners):
    for parameters in ({}, {"mesh_damping": 20.0, "friction_torque": 1.0}):
        work = Work(compliant(**parameters))
        for crank, deviation in (*corners, (0.0, 0.0)):
            work.lead(crank, deviation, parts=40, step=1e-3)
        assert work.taken > -work.unknown - 1e-12


def test_the_energy_s_balance_closes_as_the_path_is_walked_in_finer_parts():
    """Work done is energy stored and energy lost: with friction, damping and losses, to second order."""
    corners = [(0.02 * i, d) for i, d in enumerate((2.2e-4, 2.7e-4, 1e-4, -2.5e-4, -2e-4, 2.6e-4))]
    lossy = ((0.0, 0.95, 0.9, 0.02, 0.02),)
    left = []
    for parts in (16, 64):
        work = Work(compliant(0.0, lossy, mesh_damping=10.0, friction_torque=2.0))
        for corner in corners:
            work.lead(*corner, parts=parts)
        left.append(abs(work.taken - work.model.dissipated_energy) / work.model.dissipated_energy)
        assert work.model.dissipated_energy > 1e-3
    assert left[1] < 0.02
    assert left[1] < 0.4 * left[0]


def random_motion(steps, **parameters):
    random = np.random.default_rng(7)
    work = Work(compliant(**parameters))
    deepest = 0.0
    crank = deviation = 0.0
    speeds = np.zeros(2)
    for _ in range(steps):
        speeds = 0.97 * speeds + 0.03 * random.normal(0.0, (2e-2, 2e-5))
        crank, wanted = crank + speeds[0], deviation + speeds[1]
        deviation = min(max(wanted, -3e-4), 3e-4)
        speeds[1] *= -1.0 if wanted != deviation else 1.0
        work.lead(crank, deviation)
        deepest = min(deepest, work.taken)
    return work, deepest


@pytest.mark.parametrize("parameters", [{}, {"mesh_damping": 10.0, "friction_torque": 0.5}])
def test_random_motion_never_gains_energy(parameters):
    work, deepest = random_motion(1500, **parameters)
    assert work.throughput > 1e-3
    assert deepest > -2e-4 * work.throughput
    if parameters:
        assert work.taken == pytest.approx(work.model.dissipated_energy, rel=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("parameters", [{}, {"mesh_damping": 10.0, "friction_torque": 0.5}])
def test_a_million_steps_of_random_motion_never_gain_energy(parameters, record_property):
    work, deepest = random_motion(STEPS, **parameters)
    record_property(
        f"{STEPS} steps of random motion: energy that went through, was taken, dissipated, and ever gained",
        f"{work.throughput:.4g}, {work.taken:.4g}, {work.model.dissipated_energy:.4g} and {max(-deepest, 0.0):.3g} J",
    )
    # The work's sum errs by the same few steps however long the motion is: a millionth of a million steps' throughput.
    assert deepest > -work.throughput / STEPS
    if parameters:
        assert work.taken == pytest.approx(work.model.dissipated_energy, rel=0.05)


@pytest.mark.parametrize("place", [0.3, 0.7, 1.5, 3.0, 6.0, 12.0, 25.0, 50.0])
def test_sliding_friction_takes_its_power_at_every_angle(place):
    # How a strain of micrometres is rounded beside an angle depends on the angle's power of two.
    model, speed, lost = compliant(friction_torque=5.0), 0.05, []
    for i in range(5):
        put(model, PLAY.ratio * (place + 1e-3 * speed * i), 0.0, PLAY.ratio * speed)
        model.advance(1e-3)
        lost.append(model.dissipated_energy)
        if i > 0:  # it slides
            assert model.power_loss == pytest.approx(5.0 * speed, rel=1e-9)
    assert lost[-1] - lost[-2] == pytest.approx(5.0 * speed * 1e-3, rel=1e-6)


def test_a_loss_that_is_set_before_the_start_acts_at_once_and_from_the_start_on():
    model = compliant()
    put(model, 0.0, 0.0, 1.0)
    assert model.crank_torque == 0.0
    model.set_loss(0, 3, 0.5)
    assert model.crank_torque == 0.5
    assert model.power_loss == 0.5
    model.forget_history()
    model.advance()
    assert model.crank_torque == 0.5


def test_damping_acts_in_contact_only_never_pulls_and_takes_c_times_the_square_of_the_speed():
    model, elastic = compliant(mesh_damping=10.0), compliant()
    for speed in (0.1, -0.1, -100.0, 100.0):
        for m in (model, elastic):
            put(m, 0.4, 2.6e-4, 0.0, speed)
        assert model.torque >= 0.0
        wanted = max(min(10.0 * speed, elastic.torque), -elastic.torque)
        assert model.torque - elastic.torque == pytest.approx(wanted, rel=1e-9)
        assert model.power_loss == pytest.approx(wanted * speed, rel=1e-9)
    put(model, 0.4, 0.0, 0.0, 1.0)
    assert model.torque == 0.0


def test_friction_holds_slides_and_turns_its_sliding_to_heat():
    """Iwan's uniform distribution: f(z) = F (1 - (1 - z/z_p)²) in five chords, slides at F."""
    model, z = compliant(friction_torque=2.0), OUTPUT_PRESLIDING_ANGLE
    put(model, 0.0, 0.0)
    model.forget_history()
    put(model, 0.0, 0.4 * z)
    wanted = 2.0 * 2.0 * 9.0 / 30.0  # two of five chords: j (2 N - j + 1)/(N (N + 1))
    assert model.torque == pytest.approx(wanted)
    model.advance(1e-3)
    assert model.torque == pytest.approx(wanted)
    assert model.dissipated_energy + model.elastic_energy == pytest.approx(
        0.2 * z * (0.5 * 10.0 + 0.5 * (10.0 + 18.0)) / 15.0, rel=1e-9
    )
    put(model, 0.0, 0.4 * z, 0.0, 2.6 * z / 1e-3)
    before = model.dissipated_energy
    model.advance(1e-3)
    assert model.torque == pytest.approx(2.0)
    assert model.power_loss == pytest.approx(2.0 * 2.6 * z / 1e-3)
    assert model.dissipated_energy - before > 2.0 * 2.0 * z


def test_friction_that_is_switched_on_is_unstrained_at_first():
    """Whatever way the output went without it: switching it on gives no energy."""
    model = compliant()
    Work(model).lead(0.2, 3.0 * HALF)
    model.output_speed = 0.0
    before = model.elastic_energy, model.torque
    model.friction_torque = 5.0
    assert (model.elastic_energy, model.torque) == pytest.approx(before, rel=1e-9)
    Work(model, 0.2, 3.0 * HALF).lead(0.2, 3.0 * HALF + 0.5 * OUTPUT_PRESLIDING_ANGLE)
    assert model.torque > before[1] + 0.5 * 5.0


def test_an_inertia_inside_swings_as_mass_and_spring_and_keeps_its_energy():
    inertia, load, kick = 0.05, 100.0, 1e-3
    model = compliant(inertia, torque=load)
    model.crank_angle = 0.3
    model.forget_history()
    model.advance()
    at_rest, stiffness = model.output_angle, model.torsional_stiffness
    model.advance(1e-3)
    assert model.output_angle == pytest.approx(at_rest, abs=1e-13)
    struck(model, inertia, kick)
    energies, angles = [], []
    for _ in range(200):
        model.advance(1e-4)
        kinetic = 0.5 * inertia * model.output_speed**2
        energies.append(kinetic + model.elastic_energy - load * (model.output_angle - at_rest))
        angles.append(model.output_angle - at_rest)
    scale = 0.5 * inertia * kick**2
    assert np.ptp(energies) < 2e-5 * scale
    assert max(angles) == pytest.approx(kick * math.sqrt(inertia / stiffness), rel=0.02)
    crossings = np.flatnonzero(np.diff(np.sign(angles)) > 0)
    period = (crossings[-1] - crossings[0]) / (len(crossings) - 1) * 1e-4
    assert period == pytest.approx(2 * math.pi * math.sqrt(inertia / stiffness), rel=0.03)


def test_an_inertia_inside_decays_by_its_damping():
    inertia, damping = 0.05, 20.0
    model = compliant(inertia, torque=100.0, mesh_damping=damping)
    model.forget_history()
    model.advance()
    at_rest = model.output_angle
    struck(model, inertia, 1e-3)
    peaks = []
    for _ in range(7):
        swing = []
        for _ in range(20):
            model.advance(1e-4)
            swing.append(0.5 * inertia * model.output_speed**2)
        peaks.append(max(swing))
    rate = -np.polyfit(np.arange(7) * 2e-3, np.log(peaks), 1)[0]
    assert rate == pytest.approx(damping / inertia, rel=0.1)
    assert model.output_angle == pytest.approx(at_rest, abs=1e-6)


def test_vibration_at_a_resonance_is_inversely_proportional_to_the_damping():
    """Steady speed under a torque of the mesh's natural frequency is that torque over the damping."""
    inertia, swing = 0.05, 0.2
    for damping in (20.0, 60.0):
        model = compliant(inertia, torque=100.0, mesh_damping=damping)
        model.forget_history()
        model.advance()
        frequency = math.sqrt(model.torsional_stiffness / inertia)
        assert 0.02 < 0.5 * damping / (inertia * frequency) < 0.2  # of damping ratios that are published
        step = 2.0 * math.pi / frequency / 60
        settled = round(10.0 * inertia / damping / step)
        speeds = []
        for k in range(settled + 120):
            model.torque = 100.0 + swing * math.sin(frequency * (k + 0.5) * step)
            model.advance(step)
            speeds.append(model.output_speed)
        assert np.ptp(speeds[settled:]) / 2.0 == pytest.approx(swing / damping, rel=0.05)


def test_an_inertia_inside_crosses_the_play_and_bounces_without_gaining():
    inertia, load = 0.05, 5.0
    model = compliant(inertia, torque=-load, mesh_damping=5.0)
    model.forget_history()
    sum_before = model.elastic_energy - load * model.output_angle
    sides, energies = set(), []
    for _ in range(100):
        model.torque = load
        model.advance(1e-3)
        sides.add(model.torsional_stiffness > 0.0)
        energies.append(
            0.5 * inertia * model.output_speed**2
            + model.elastic_energy
            - load * model.output_angle
            + model.dissipated_energy
        )
    assert sides == {True, False}
    assert np.ptp([sum_before, *energies]) < 1e-6 * load * HALF
    assert model.dissipated_energy > 0.1 * load * HALF


def coupled(h, delayed, damping=0.0, periods=20):
    """Largest swing at the end over that at the start, of a mass outside: ω₀h as h, torque held over each step.

    The damping is given in k h/2.
    """
    model = compliant()
    rest = float(solve(DriveValue(PLAY, SURFACE), 100.0, 0.3).transmission_error[0, 0])
    put(model, 0.3, rest)
    stiffness, load = model.torsional_stiffness, model.torque
    inertia, step = 0.05, h / math.sqrt(stiffness / 0.05)
    model.mesh_damping = damping * stiffness * step / 2.0
    x, v, torque, swings = 1e-8, 0.0, None, []
    for _ in range(round(periods * 2 * math.pi / h)):
        put(model, 0.3, rest + x, 0.0, v)
        if not delayed or torque is None:
            torque = model.torque
        acceleration = (load - torque) / inertia
        x, v, before = x + step * v + 0.5 * step**2 * acceleration, v + step * acceleration, (x, v)
        put(model, 0.3, rest + before[0], 0.0, before[1])
        if delayed:
            torque = model.torque
        swings.append(abs(x))
    turn = round(2 * math.pi / h)
    return max(swings[-turn:]) / max(swings[:turn])


def test_a_stiff_contact_stays_stable_at_a_step_where_a_late_torque_does_not():
    """ω₀h = 0.05: one step late it grows some 100-fold in 20 periods, read from the same place 5-fold, damped not."""
    assert coupled(0.05, delayed=True) > 50.0
    assert coupled(0.05, delayed=False) == pytest.approx(math.exp(20 * math.pi / 2 * 0.05), rel=0.15)
    # Held over each step h the torque is h/2 late; damping above k h/2 makes up for that.
    assert coupled(0.05, delayed=False, damping=2.0) < 0.5
    assert coupled(0.05, delayed=False, damping=0.5) > 1.5
    assert coupled(0.05, delayed=True, damping=4.0) < 0.5


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"step": 1e6, "mesh_damping": 1.0}, "divided into more than"),
        ({"step": -1e-3}, "not below 0"),
        ({"step": math.nan}, "finite"),
        ({"output_angle": 0.5}, f"within {LARGEST_TRANSMISSION_ERROR:g} rad"),
    ],
)
def test_a_refused_step_says_why_and_moves_nothing(change, said):
    model = compliant(friction_torque=1.0, mesh_damping=1.0)
    put(model, 0.2, 2.4e-4, 5.0, 0.01)
    model.advance(1e-3)
    kept = {k: v for k, v in change.items() if k != "step"}
    for name, value in kept.items():
        setattr(model, name, value)
    before = model.state()
    with pytest.raises(StepError, match=said):
        model.advance(change.get("step", 1e-3))
    assert model.state() == before


def test_its_state_restores_exactly():
    model = compliant(0.05, torque=40.0, friction_torque=1.0, mesh_damping=5.0, series_compliance=1e-7)
    model.crank_speed = 20.0
    model.forget_history()

    def walk(m):
        found = []
        for i in range(12):
            m.torque = 40.0 * math.cos(i)
            m.advance(5e-4)
            found.append((m.output_angle, m.crank_torque, m.backlash, m.contact_count, m.dissipated_energy))
        return found

    walk(model)
    state = model.state()
    first = walk(model)
    other = compliant(0.05)
    other.restore(state)
    model.restore(state)
    assert walk(other) == walk(model) == first


def test_losses_are_those_of_modelica_s_lossy_gear():
    """LossyGear.mo of the Modelica Standard Library: its torque loss is the torque added to that of the teeth."""
    table = ((0.0, 0.8, 0.7, 0.5, 0.6), (100.0, 0.9, 0.85, 0.7, 0.9))
    free = kinematic_drive(DriveValue(PLAY, SURFACE))
    lossy = kinematic_drive(DriveValue(PLAY, SURFACE), table)
    for speed, load in itertools.product((50.0, -50.0, 500.0), (390.0, 12.0, 0.0, -8.0, -31.0, -390.0)):
        forward, backward, friction_forward, friction_backward = (
            np.interp(abs(speed), (0.0, 100.0), column) for column in list(zip(*table, strict=True))[1:]
        )
        for model in (free, lossy):
            model.crank_speed, model.torque = speed, load
            model.advance()
        torque, taken = free.crank_torque, lossy.crank_torque
        # `flange_a.tau` is `taken`; LossyGear computes the loss from it.
        bearing = (friction_forward - friction_backward) / (forward - 1.0 / backward)
        if speed > 0.0:
            quadrant1 = (1.0 - forward) * taken + friction_forward
            quadrant2 = (1.0 - 1.0 / backward) * taken + friction_backward
            wanted = quadrant1 if taken - bearing >= 0.0 else quadrant2
        else:
            quadrant4 = (1.0 - 1.0 / backward) * taken - friction_backward
            quadrant3 = (1.0 - forward) * taken - friction_forward
            wanted = quadrant4 if taken + bearing >= 0.0 else quadrant3
        assert taken - torque == pytest.approx(wanted)
        assert (taken - torque) * speed > 0.0


def test_power_is_balanced_with_losses_in_the_kinematic_drive():
    for torque in (80.0, -80.0):
        model = kinematic_drive(DriveValue(PLAY, SURFACE), ((0.0, 0.9, 0.85, 0.1, 0.1),))
        model.crank_speed, model.crank_angle, model.torque = 100.0, 0.5, torque
        model.advance()
        power = model.crank_torque * 100.0 + torque * model.output_speed
        assert model.power_loss > 0.0
        # The remainder is the change of energy stored in the contacts over the mesh; its mean over a turn is zero.
        assert power == pytest.approx(model.power_loss, abs=0.02 * abs(torque * model.output_speed))


def test_without_backlash_the_drive_loses_its_play_and_keeps_its_stiffness():
    for torque in (60.0, -60.0):
        model, closed = (kinematic_drive(DriveValue(PLAY, SURFACE)) for _ in range(2))
        closed.backlash_on = False
        for m in (model, closed):
            m.crank_angle, m.torque, m.crank_speed = 0.4, torque, 10.0
            m.advance()
        play = model.backlash
        assert closed.backlash == 0.0
        moved = model.transmission_error - closed.transmission_error
        assert moved == pytest.approx(math.copysign(0.5 * play, torque), rel=1e-9)
        assert closed.torsional_stiffness == pytest.approx(model.torsional_stiffness, rel=1e-9)
        speed, before = closed.output_speed, closed.output_angle
        closed.crank_angle += 1e-6
        closed.advance()
        assert (closed.output_angle - before) / 1e-6 * 10.0 == pytest.approx(speed, rel=1e-4)
    closed.torque = 0.0
    closed.advance()
    ends = solve(DriveValue(PLAY, SURFACE), 0.0, closed.crank_angle)
    assert closed.transmission_error == pytest.approx(0.5 * (ends.play_low[0] + ends.play_high[0]), abs=1e-11)


@pytest.mark.parametrize("step", [10e-3, 5e-3, 2e-3, 1e-3])
def test_play_against_the_event_exact_solution(step):
    """A crank that swings: in exact time each flank pushes up to the very reversal, the FMU up to its last sample."""
    amplitude, omega, last = 0.6, 2 * math.pi * 2.0, 1.0
    time = np.arange(0.0, last + step / 2, step)
    reversals = (np.arange(0.5, 4.0 * last, 1.0)) * math.pi / omega
    both = np.union1d(time, reversals)
    crank = amplitude * np.sin(omega * both)
    ends = solve(DriveValue(PLAY, SURFACE), 0.0, crank)
    low, high = crank / PLAY.ratio + ends.play_low, crank / PLAY.ratio + ends.play_high
    exact = np.empty(both.size)
    exact[0] = 0.5 * (low[0] + high[0])
    for i in range(1, both.size):
        exact[i] = min(max(exact[i - 1], low[i]), high[i])
    model = kinematic_drive(DriveValue(PLAY, SURFACE))
    found = []
    for t in time:
        model.crank_angle = amplitude * math.sin(omega * t)
        model.advance()
        found.append(model.output_angle)
    error = np.abs(np.array(found) - exact[np.searchsorted(both, time)])
    # Between samples the crank goes at most A ω² h²/8 beyond them.
    assert error.max() < 1.02 * amplitude * omega**2 * step**2 / 8.0 / abs(PLAY.ratio) + 1e-11
    assert np.ptp(found) > 0.5 * np.ptp(crank / PLAY.ratio)


def test_a_loss_table_is_read_with_its_units(tmp_path):
    path = tmp_path / "losses.csv"
    path.write_text(
        "speed [rpm],eta_mf1 [percent],eta_mf2 [1],tau_bf1 [N*m],tau_bf2 [N*m]\n0,90,0.8,0.1,0.2\n60,95,0.9,0.1,0.2\n"
    )
    rows = read_losses(path)
    assert rows[1] == pytest.approx((2 * math.pi, 0.95, 0.9, 0.1, 0.2))


@pytest.mark.parametrize(
    ("row", "said"),
    [
        ("5,0.9,0.9,0,0", r"loss_table\[1,1\] = 0.523599: speeds must ascend from 0"),
        ("0,1.2,0.9,0,0", r"loss_table\[1,2\] = 1.2"),
        ("0,0.9,-0.1,0,0", r"loss_table\[1,3\] = -0.1"),
        ("0,0.9,0.9,-1,0", r"loss_table\[1,4\] = -1"),
        ("0,0.9,x,0,0", "line 2"),
        ("0,0.9", "line 2"),
    ],
)
def test_a_table_that_is_none_is_refused_in_a_sentence(tmp_path, row, said):
    path = Path(tmp_path / "losses.csv")
    path.write_text("speed [rpm],eta_mf1 [1],eta_mf2 [1],tau_bf1 [N*m],tau_bf2 [N*m]\n" + row + "\n")
    with pytest.raises(edge.InputError, match=said):
        read_losses(path)


def host(step, time=0.02, crank_inertia=1e-4, output_inertia=0.5, load=50.0):
    """A multibody host: both inertias outside, their torques constant over each step, speeds before angles."""
    model = compliant()
    put(model, 0.0, 0.0)
    model.forget_history()
    model.advance()
    for _ in range(round(time / step)):
        model.crank_speed += step * -model.crank_torque / crank_inertia
        model.output_speed += step * (load - model.torque) / output_inertia
        model.advance(step)
        model.crank_angle += step * model.crank_speed
        model.output_angle += step * model.output_speed
    return model


def test_a_host_whose_steps_are_too_long_is_told_the_step_and_what_to_do():
    """The suggested step holds; at twenty times this step the flanges leave each other."""
    said = (
        r"rad from flange_a\.phi/ratio after a step of 0\.002 s: it must stay within 0\.01 rad; make shorter steps "
        r"\(0\.0001 s is suggested\), or build the FMU with the inertias inside \(--output-inertia, --crank-inertia\)$"
    )
    assert abs(host(1e-4).transmission_error) < 1e-3
    with pytest.raises(StepError, match=said):
        host(2e-3, time=1.0)
    put(model := compliant(), 0.0, 0.02)
    with pytest.raises(StepError, match=r"flange_a\.phi/ratio: it must stay within 0\.01 rad$"):
        model.advance()
