"""Friction at both flanges, exact and native: against Masing's rules, closed forms and SciPy."""

import ctypes
import dataclasses
import itertools
import math

import numpy as np
import pytest
from c_host import INTERFACES, RIPPLE, Slave, compiled, native_of
from clockworks import Drive, compliant_drive, kinematic_drive
from common import EXAMPLES
from scipy.integrate import solve_ivp

from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.fmu.friction_file import Friction
from cycloid_fmu.fmu.library import SOURCES, source_files
from cycloid_fmu.fmu.variables import ATTRIBUTES, Interface
from cycloid_fmu.reducer import lost_motion as rv
from cycloid_fmu.reducer.description import read_reducer
from cycloid_fmu.surfaces.surface import nominal_surface

ANGLE = 2e-3  # rad: the presliding angle of flange_a
KINDS = ("exact", "native")


class Exact:
    """The model in Python with the native FMU's manners."""

    def __init__(self, drive, interface):
        self.model = Drive(drive, interface)

    def put(self, **values):
        for name, value in values.items():
            name = name.replace("flange_a_", "flange_a.").replace("flange_b_", "flange_b.")
            setattr(self.model, ATTRIBUTES.get(name, name), value)

    def start(self, **values):
        self.put(**values)
        self.model.forget_history()
        self.model.advance()

    def step(self, size=1e-3):
        self.model.advance(size)

    def get(self, *names):
        return [getattr(self.model, ATTRIBUTES.get(name, name)) for name in names]


class Native:
    def __init__(self, path, folder):
        self.slave = Slave(path, folder)
        self.put, self.get, self.start = self.slave.put, self.slave.get, self.slave.start

    def step(self, size=1e-3):
        self.slave.fmi.doStep(0.0, size)


@pytest.fixture
def opened(drive, tmp_path):
    """A drive of the examples with an interface, "exact" or "native", not yet started."""
    made = []

    def one(kind, interface):
        if kind == "exact":
            return Exact(drive, interface)
        folder = tmp_path / str(len(made))
        folder.mkdir()
        path = native_of(folder, drive, drive.tables, interface)
        made.append(Native(path, folder / "unpacked"))
        return made[-1]

    yield one
    for each in made:
        each.slave.fmi.freeInstance()


# --- one flange, against rules that know nothing of elements ---


def virgin(strain, most=1.0, angle=ANGLE):
    """First loading: the parabola F (1 - (1 - z/z_p)²) in five chords, as ordinates j (11 - j)/30."""
    nodes = np.arange(6)
    return np.sign(strain) * most * np.interp(abs(strain) / angle * 5.0, nodes, nodes * (11.0 - nodes) / 30.0)


def masing(path, most=1.0, angle=ANGLE):
    """Torque along a path from rest: Masing's rules, with a stack of the reversals that are remembered.

    A branch after a reversal is the first loading in twice the size; where it comes back to the reversal before, both
    are forgotten, and the branch before continues.
    """
    reversals, torque, found, before, going = [], 0.0, [], 0.0, 0.0
    for z in path:
        way = z - before
        if way != 0.0:
            if way * going < 0.0:
                reversals.append((before, torque))
            going = math.copysign(1.0, way)
            while len(reversals) >= 2 and (z - reversals[-2][0]) * going >= 0.0:
                del reversals[-2:]
            if len(reversals) == 1 and abs(z) >= abs(reversals[0][0]) and (z > 0.0) == (going > 0.0):
                reversals.clear()
        if reversals:
            at, of = reversals[-1]
            torque = of + 2.0 * virgin(0.5 * (z - at), most, angle)
        else:
            torque = virgin(z, most, angle)
        found.append(torque)
        before = z
    return np.array(found)


@pytest.mark.parametrize("kind", KINDS)
def test_losses_take_their_ripple_more_at_each_crank_angle(opened, kind):
    """By flank and direction of power, between the stated speeds and loads and beyond; none without load."""
    lossy = INTERFACES["kinematic"]
    bare, even, rippled = (
        opened(kind, interface) for interface in (Interface(), lossy, dataclasses.replace(lossy, loss_ripple=RIPPLE))
    )
    for load, direction in itertools.product((60.0, -60.0, 250.0, -9.0), (1.0, -1.0)):
        for drive in (bare, even, rippled):
            drive.put(flange_b_tau=load, flange_a_w=20.0 * direction, flange_a_phi=0.0)
        if load == 60.0 and direction == 1.0:
            for drive in (bare, even, rippled):
                drive.start()
        for angle in direction * np.arange(0.05, 0.6, 0.05):
            for drive in (bare, even, rippled):
                drive.put(flange_a_phi=angle)
                drive.step()
            (asked,), (mean,), (torque,) = (drive.get("flange_a.tau") for drive in (bare, even, rippled))
            (wanted,) = RIPPLE.torque(np.array([angle]), asked, asked * direction > 0.0, 20.0)
            assert torque - mean == pytest.approx(direction * wanted, abs=1e-9)
    assert not RIPPLE.torque(np.linspace(0.0, 1.0, 5), 0.0, True, 20.0).any()


@pytest.mark.parametrize("kind", KINDS)
def test_what_rippling_losses_take_is_dissipated(opened, kind):
    """Over two crank turns between inertias: work done on both is kinetic, elastic or dissipated energy."""
    inertias = {"output_inertia": 2.0, "crank_inertia": 1e-3, "mesh_damping": 0.0}
    joint = opened(kind, Interface("compliant", losses=INTERFACES["kinematic"].losses, loss_ripple=RIPPLE, **inertias))
    torque, load = 1.0, 30.0
    joint.start(crank_speed_start=60.0, flange_a_tau=torque, flange_b_tau=load)
    names = ("flange_a.phi", "flange_b.phi", "flange_a.w", "flange_b.w", "elastic_energy", "dissipated_energy")

    def energy(crank_speed, speed, elastic, dissipated):
        return 0.5e-3 * crank_speed**2 + 0.5 * 2.0 * speed**2 + elastic + dissipated

    crank, output, *begun = joint.get(*names)
    for _ in range(100):
        joint.step(2e-3)
    turned, moved, *ended = joint.get(*names)
    work = torque * (turned - crank), load * (moved - output)
    assert abs(turned - crank) > 4.0 * math.pi
    assert energy(*ended) - energy(*begun) == pytest.approx(sum(work), abs=1e-7 * sum(map(abs, work)))


class Yields(ctypes.Structure):
    _fields_ = (("low", ctypes.c_double), ("high", ctypes.c_double))


class Slid(ctypes.Structure):
    _fields_ = (("torque", ctypes.c_double), ("slope", ctypes.c_double), ("lost", ctypes.c_double))


@pytest.fixture(scope="module")
def slide(tmp_path_factory):
    """`friction_slide` of the C sources: strains at the end, mean torque and lost energy of a displacement."""
    folder = tmp_path_factory.mktemp("friction")
    for name, data in source_files().items():
        (folder / name).write_bytes(data)
    sources = [folder / name for name in SOURCES]
    library = ctypes.CDLL(str(compiled(folder / "friction.so", sources, "-shared", "-fPIC", f"-I{folder}")))
    function, five, number = library.friction_slide, ctypes.c_double * 5, ctypes.c_double
    function.restype, function.argtypes = Slid, (five, five, number, number, number, Yields)

    def slid(strains, way, time, stiffness, low, high):
        end = five()
        found = function(five(*strains), end, way, time, stiffness, Yields(low, high))
        return list(end), found.torque, found.lost

    return slid


def test_a_loop_follows_masing_s_rules_and_remembers_its_reversals(slide):
    """Loops within loops: each closes where it began, and the outer one continues as if it had not been."""
    corners = ANGLE * np.array([0.0, 0.9, -0.7, 0.4, -0.2, 0.1, -0.2, 0.4, -0.7, 0.9, 0.5, 0.95, -0.95, 0.2])
    path = np.concatenate([np.linspace(a, b, 41)[1:] for a, b in itertools.pairwise(corners)])
    stiffness, strains, torques, lost, work = 2.0 / (6.0 * ANGLE), [0.0] * 5, [], 0.0, 0.0
    for way in np.diff(path, prepend=0.0):
        strains, torque, heat = slide(strains, way, 0.0, stiffness, 1.0, 1.0)
        lost, work = lost + heat, work + torque * way
        torques.append(stiffness * sum(strains))
        assert heat >= 0.0
    np.testing.assert_allclose(torques, masing(path), atol=1e-12)
    assert work == pytest.approx(0.5 * stiffness * np.dot(strains, strains) + lost, rel=1e-12)
    assert lost > 0.0


def test_what_slides_less_slips_back_and_never_gains(slide):
    """Load, speed and displacement at random: elements give back only stored energy."""
    random = np.random.default_rng(2)
    strains, given, lost = [0.0] * 5, 0.0, 0.0
    for _ in range(3000):
        most = 1.0 + 3.0 * abs(random.normal()) + 0.5 * math.exp(-(random.normal() ** 2))
        way, time = 1e-3 * random.normal(), random.choice([0.0, 1e-4, 1e-2])
        strains, torque, heat = slide(strains, way, time, 500.0, most, most)
        assert heat >= 0.0
        assert abs(torque) <= most * (1.0 + 1e-12)
        given, lost = given + torque * way, lost + heat
        assert given - lost == pytest.approx(250.0 * np.dot(strains, strains), abs=1e-12 * given)


# --- through the FMU ---


@pytest.mark.parametrize("kind", KINDS)
def test_both_flanges_of_the_compliant_interface_loop_as_masing_has_it(opened, kind):
    """Within the play the teeth carry nothing: the torque at a flange is its friction."""
    found = opened(
        kind,
        Interface(
            "compliant",
            mesh_damping=0.0,
            input_friction=Friction(coulomb=0.02),
            output_friction=Friction(coulomb=6.0, presliding_angle=1e-5),
        ),
    )
    found.start()
    (free,) = found.get("backlash")
    assert free > 1.5e-5
    corners = np.array([0.0, 0.6, -0.5, 0.3, -0.3, 0.3, -0.5, 0.6, 0.2])
    path = np.concatenate([np.linspace(a, b, 12)[1:] for a, b in itertools.pairwise(corners)])
    felt = []
    for z in path:
        found.put(flange_a_phi=ANGLE * z / 10.0, flange_b_phi=1e-5 * z)
        found.step()
        felt.append(found.get("flange_a.tau", "flange_b.tau"))
    np.testing.assert_allclose(np.array(felt)[:, 0], 0.02 * masing(path / 10.0, 1.0, 1.0), atol=1e-12)
    np.testing.assert_allclose(np.array(felt)[:, 1], 6.0 * masing(path, 1.0, 1.0), atol=1e-9)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("share", [0.0, 0.05])
def test_the_loop_of_the_locked_crank_widens_with_the_load(drive, opened, kind, share):
    """Torque up and down on the output: the teeth bear (T - C)/(1 + s) on the way up, (T + C)/(1 - s) down."""
    most, coulomb = 120.0, 2.0
    elastic = kinematic_drive(drive.stage)

    def place(torque):
        elastic.torque = torque
        elastic.advance()
        return elastic.output_angle

    law = Friction(coulomb=coulomb, load_share=share, presliding_angle=1e-7)
    found = opened(kind, Interface(output_friction=law))
    found.start()
    torques = np.concatenate([np.linspace(a, b, 25)[1:] for a, b in ((0, most), (most, -most), (-most, most))])
    angles = []
    for torque in torques:
        found.put(flange_b_tau=torque)
        found.step()
        angles += found.get("flange_b.phi")
    allowed = 1e-10 if kind == "exact" else 1e-7
    width = []
    for torque in (30.0, 50.0, 80.0):
        down, up = (angles[begin + int(np.argmin(abs(torques[begin : begin + 24] - torque)))] for begin in (24, 48))
        wanted = place((torque - coulomb) / (1.0 + share)), place((torque + coulomb) / (1.0 - share))
        assert (up, down) == pytest.approx(wanted, abs=allowed)
        width.append(wanted[1] - wanted[0])
    assert (width[2] > 1.3 * width[0]) == (share > 0.0)


@pytest.mark.parametrize("kind", KINDS)
def test_friction_of_the_kinematic_output_balances_its_torque_at_every_place(drive, opened, kind):
    """T = M + f: the teeth's torque M at the place, by the drive without friction, and f by Masing's rules."""
    coulomb, angle = 5.0, 1e-5
    found = opened(kind, Interface(output_friction=Friction(coulomb=coulomb, presliding_angle=angle)))
    found.start(flange_b_tau=40.0)
    (begun,) = found.get("flange_b.phi")
    corners = (40, 70, 40, 65, 45, 55, 40, 80)
    torques = np.concatenate([np.linspace(a, b, 9)[1:] for a, b in itertools.pairwise(corners)])
    angles = []
    for torque in torques:
        found.put(flange_b_tau=torque)
        found.step()
        angles += found.get("flange_b.phi")
    friction = masing(np.array(angles) - begun, coulomb, angle)
    elastic = kinematic_drive(drive.stage)
    wanted = []
    for torque in torques - friction:
        elastic.torque = torque
        elastic.advance()
        wanted.append(elastic.output_angle)
    np.testing.assert_allclose(angles, wanted, atol=1e-10 if kind == "exact" else 5e-8)
    assert np.ptp(friction) > 1.2 * coulomb


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("step", [1e-4, 1e-3])
@pytest.mark.parametrize("late", [False, True])
def test_a_motor_outside_stops_and_stands(opened, kind, step, late):
    """0.02 N·m holds 1e-4 kg·m² that a host integrates, its torque held over the step or one step late."""
    found, inertia, friction = opened(kind, Interface(losses=((0.0, 1.0, 1.0, 0.02, 0.02),))), 1e-4, 0.02
    found.start()
    angle, speed, torque, speeds, angles = 0.0, 5.0, 0.0, [], []
    for _ in range(1500):
        found.put(flange_a_phi=angle, flange_a_w=speed)
        found.step(step)
        before, torque = (
            torque,
            *found.get("flange_a.tau"),
        )
        change = step * (0.64 * friction - (before if late else torque)) / inertia
        angle, speed = angle + step * (speed + 0.5 * change), speed + change
        speeds.append(speed)
        angles.append(angle)
    standing = 1000
    assert np.abs(speeds[standing:]).max() < 1e-3 * 5.0
    assert np.ptp(angles[standing:]) < 0.1 * ANGLE
    assert np.abs(speeds[-100:]).max() < 1e-5


@pytest.mark.parametrize("share", [*(pytest.param(one, marks=pytest.mark.slow(3)) for one in (0.64, 0.99)), 1.01])
def test_a_load_below_breakaway_is_held_without_creep(opened, share):
    """Motor and arm inside, the motor's torque raised to a share of its breakaway, then 100 s."""
    found = opened(
        "native",
        Interface(
            "compliant",
            2.0,
            crank_inertia=1e-4,
            input_friction=Friction(coulomb=0.05),
            output_friction=Friction(coulomb=3.0),
        ),
    )
    found.start(series_compliance=5e-6)
    for i in range(500):
        found.put(flange_a_tau=min(i / 400.0, 1.0) * share * 0.05)
        found.step(1e-3)
    (reached,) = found.get("flange_a.phi")
    for _ in range(10):
        found.step(10.0 if share < 1.0 else 1e-2)
    (after,) = found.get("flange_a.phi")
    if share < 1.0:
        assert 0.0 < reached < 1.1 * ANGLE
        assert abs(after - reached) < 1e-3 * ANGLE
    else:
        assert after > 3.0 * ANGLE


@pytest.mark.parametrize("kind", KINDS)
def test_friction_falls_with_the_temperature_and_takes_its_power(opened, kind):
    """Sliding without load: (C + S exp(-(w/w_s)²) + D w) exp(-β (T - T_ref)), and the loss table with it."""
    law = Friction(
        coulomb=0.05,
        stribeck=0.03,
        stribeck_speed=20.0,
        viscous=1e-3,
        temperature_coefficient=0.02,
        reference_temperature=300.0,
    )
    found = opened(kind, Interface(losses=((0.0, 1.0, 1.0, 0.01, 0.01),), input_friction=law))
    found.start()
    for temperature, speed in ((300.0, 10.0), (335.0, 10.0), (280.0, -40.0)):
        found.put(temperature=temperature, flange_a_w=speed)
        found.step()
        warm = math.exp(-0.02 * (temperature - 300.0))
        wanted = (0.06 + 0.03 * math.exp(-((speed / 20.0) ** 2)) + 1e-3 * abs(speed)) * warm
        assert found.get("flange_a.tau") == [pytest.approx(math.copysign(wanted, speed), rel=1e-12)]
        assert found.get("power_loss") == [pytest.approx(wanted * abs(speed), rel=1e-12)]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("interface", ["kinematic", "compliant", "joint"])
def test_a_state_holds_what_friction_remembers(opened, kind, interface):
    laws = {"input_friction": Friction(coulomb=0.02), "output_friction": Friction(coulomb=3.0, load_share=0.02)}
    inertias = {"output_inertia": 0.5, "crank_inertia": 1e-3} if interface == "joint" else {}
    offered = Interface("compliant" if inertias else interface, mesh_damping=0.0, **inertias, **laws)
    found = opened(kind, offered)
    found.start()
    outputs = ["flange_a.tau", "flange_b.phi"] if interface == "kinematic" else ["flange_a.tau", "flange_b.tau"]
    outputs = ["flange_a.phi", "flange_b.phi"] if inertias else outputs

    def gone(steps):
        felt = []
        for i in steps:
            at = 1.2e-3 * math.sin(0.7 * i) * math.exp(-0.02 * i)
            if inertias:
                found.put(flange_a_tau=20.0 * at, flange_b_tau=1e3 * at)
            elif interface == "kinematic":
                found.put(flange_a_phi=at, flange_b_tau=3e4 * at)
            else:
                found.put(flange_a_phi=at, flange_b_phi=0.01 * at)
            found.step()
            felt.append(found.get(*outputs))
        return felt

    gone(range(20))
    if kind == "exact":
        state = found.model.state()
        first, _ = gone(range(20, 40)), found.model.restore(state)
    else:
        state = found.slave.fmi.getFMUState()
        kept = found.slave.fmi.serializeFMUState(state)
        first = gone(range(20, 40))
        found.slave.fmi.setFMUState(found.slave.fmi.deserializeFMUState(kept))
    assert gone(range(20, 40)) == first
    assert np.ptp(first, axis=0).min() > 0.0


@pytest.mark.parametrize("kind", KINDS)
def test_friction_that_changes_begins_anew_and_what_it_stored_is_lost(opened, kind):
    found = opened(kind, Interface("compliant", mesh_damping=0.0, output_friction=Friction(coulomb=3.0)))
    found.start()
    found.put(flange_b_phi=1.5e-5)
    found.step()
    found.step()
    stored, lost = found.get("elastic_energy", "dissipated_energy")
    assert stored > 1e-6
    found.put(friction_torque=4.0)
    after, more = found.get("elastic_energy", "dissipated_energy")
    assert after == 0.0
    assert more - lost == pytest.approx(stored, rel=1e-9)


def test_a_reducer_s_sun_and_carrier_rub_as_well():
    """With the sun locked the teeth bear T - T_f on the way up and T + T_f down; turned, both flanges lose."""
    whole = read_reducer(EXAMPLES / "rv-20e.toml")
    made = DriveValue(whole.stage, nominal_surface(whole.stage), rv.parts_of(whole)[2])
    model, elastic = kinematic_drive(made), kinematic_drive(made)
    model.set_friction(0, coulomb=0.03)
    model.set_friction(1, coulomb=4.0, presliding_angle=1e-7)
    model.advance()
    angles = []
    for torque in (*range(0, 101, 10), *range(90, 59, -10)):
        model.torque = float(torque)
        model.advance()
        angles.append(model.output_angle)
    for angle, torque in ((angles[6], 56.0), (angles[14], 64.0)):
        elastic.torque = torque
        elastic.advance()
        assert angle == pytest.approx(elastic.output_angle, abs=1e-9)
    model.torque, model.crank_angle, model.crank_speed = 0.0, 0.1, 100.0
    model.advance(1e-3)
    assert model.crank_torque == pytest.approx(0.03 + 4.0 / abs(model.ratio), rel=0.05)
    assert model.power_loss == pytest.approx(100.0 * model.crank_torque, rel=0.05)


MOTOR, ARM, LOAD, LAST = 1e-3, 2.0, 20.0, 0.09
PLACES = ("flange_a.phi", "flange_a.w", "flange_b.phi", "flange_b.w")
LAWS = (
    Friction(coulomb=0.1, load_share=0.02, stribeck=0.08, stribeck_speed=3.0, viscous=1e-3),
    Friction(coulomb=2.0, load_share=0.02, stribeck=1.0, viscous=2.0),
)


def driving(time):
    return 0.5 + 1.2 * math.sin(60.0 * time)


@pytest.fixture(scope="module")
def stuck_and_slipped(drive):
    """Motion of motor and arm with friction by SciPy, over time: elements by their law of slip, the contacts' alone."""
    contacts, ratio = compliant_drive(drive.stage), drive.pair.ratio
    contacts.forget_history()
    contacts.series_compliance, shares = 5e-6, np.arange(1, 6) / 15.0
    rated = drive.pair.rated_torque / abs(ratio), drive.pair.rated_torque
    flanges = [
        (law, (law.coulomb + law.stribeck + law.load_share * most) / (3.0 * angle), slow)
        for law, most, angle, slow in zip(LAWS, rated, (2e-3, 2e-5), (3.0, 0.05), strict=True)
    ]

    def rubbed(law, stiffness, slow, speed, load, strain):
        most = shares * (law.coulomb + law.load_share * abs(load) + law.stribeck * math.exp(-((speed / slow) ** 2)))
        torque = np.clip(stiffness * (strain + 2e-3 * speed), -most, most).sum() + law.viscous * speed
        return torque, np.where((stiffness * np.abs(strain) >= most) & (strain * speed > 0.0), 0.0, speed)

    def change(time, state):
        angle, w, output, w_b = state[:4]
        by_angle, by_rotation = contacts.pressed(angle, output)
        at_a, z_a = rubbed(*flanges[0], w, by_angle, state[4:9])
        at_b, z_b = rubbed(*flanges[1], w_b, by_rotation, state[9:])
        return [w, (driving(time) - by_angle - at_a) / MOTOR, w_b, (LOAD - by_rotation - at_b) / ARM, *z_a, *z_b]

    rest = Exact(drive, Interface("compliant", ARM, crank_inertia=MOTOR))
    rest.start(flange_b_tau=LOAD, series_compliance=5e-6)
    begin = [*rest.get(*PLACES), *[0.0] * 10]
    # Slip begins and ends all the time: steps of one length, far below the fastest swing, do for it.
    options = {"method": "RK23", "rtol": 1.0, "atol": 1.0, "max_step": 2e-5, "first_step": 2e-5}
    return solve_ivp(change, (0.0, LAST), begin, dense_output=True, **options).sol


@pytest.mark.slow(4)
@pytest.mark.parametrize(("kind", "step"), [("exact", 1e-3), ("native", 1e-3), ("native", 1e-4)])
def test_a_motor_sticks_and_slips_as_scipy_has_it(opened, stuck_and_slipped, kind, step):
    """Motor and arm inside, all kinds of friction at both flanges, through reversals and the play."""
    found = opened(
        kind,
        Interface(
            "compliant", ARM, crank_inertia=MOTOR, mesh_damping=0.0, input_friction=LAWS[0], output_friction=LAWS[1]
        ),
    )
    found.start(flange_b_tau=LOAD, series_compliance=5e-6)
    rows = [found.get(*PLACES)]
    time = step * np.arange(round(LAST / step) + 1)
    exact = stuck_and_slipped(np.minimum(time, LAST))[:4].T
    for a, b in itertools.pairwise(time):
        found.put(flange_a_tau=np.mean([driving(a + share * (b - a)) for share in (0.125, 0.375, 0.625, 0.875)]))
        found.step(b - a)
        rows.append(found.get(*PLACES))
    assert exact[:, 1].min() < -0.1 * exact[:, 1].max() < 0.0
    assert (np.abs(np.array(rows) - exact).max(axis=0) < 3e-3 * np.ptp(exact, axis=0)).all()
