"""Model Exchange and derivatives of native FMUs: as Co-Simulation has it, as SciPy has it, as differences have it."""

import math
from ctypes import c_double

import fmpy
import numpy as np
import pytest
from fmpy.fmi1 import FMICallException
from fmpy.fmi2 import FMU2Model
from fmpy.fmi3 import FMU3Model, FMU3Slave
from test_dynamics import ARM, CHAIN, reference

MOTION = ("flange_a.phi", "flange_a.w", "flange_b.phi", "flange_b.w")
STRAINS = [f"{flange}_friction_strain[{i}]" for flange in ("input", "output") for i in range(1, 6)]
STATES = {
    "kinematic": [],
    "compliant": [*STRAINS, "dissipated_energy"],
    "inertia": ["transmission_error", "flange_b.w", *STRAINS, "dissipated_energy"],
    "rotor": ["flange_a.phi", "flange_a.w", *STRAINS, "dissipated_energy"],
    "joint": ["flange_a.phi", "flange_a.w", "transmission_error", "flange_b.w", *STRAINS, "dissipated_energy"],
}


def signals(time, **of):
    """Inputs over time as fmpy takes them."""
    names = [name.replace("__", ".") for name in of]
    found = np.zeros(time.size, [("time", "f8"), *((name, "f8") for name in names)])
    found["time"] = time
    for name, values in zip(names, of.values(), strict=True):
        found[name] = values
    return found


def simulated(path, kind, last, inputs, outputs, values=(), **more):
    more.setdefault("output_interval", 1e-3)
    return fmpy.simulate_fmu(
        str(path), fmi_type=kind, stop_time=last, input=inputs, output=list(outputs), start_values=dict(values), **more
    )


@pytest.mark.parametrize("version", ["2.0", "3.0"])
@pytest.mark.parametrize("kind", list(STATES))
def test_states_and_indicators_are_described(built, kind, version):
    described = fmpy.read_model_description(str(built(kind, version)))
    assert [d.variable.derivative.name for d in described.derivatives] == STATES[kind]
    assert described.numberOfEventIndicators == 5
    for offered in (described.modelExchange, described.coSimulation):
        assert offered.providesDirectionalDerivative or version == "3.0"  # which fmpy does not read
        assert offered.modelIdentifier == "CycloidDrive"
    assert described.modelExchange.needsCompletedIntegratorStep


# --- the same motion ---


@pytest.mark.parametrize("version", [pytest.param("2.0", marks=pytest.mark.slow(3)), "3.0"])
def test_motor_and_arm_move_through_the_play_as_scipy_has_them(built, drive, version):
    last, load = 0.15, 20.0
    time = np.linspace(0.0, last, 3001)
    values = {**CHAIN, "crank_angle_start": 0.2}
    for i, row in enumerate(((0.0, 1.0, 1.0, 0.0, 0.0), (100.0, 1.0, 1.0, 0.0, 0.0)), start=1):
        values |= {f"loss_table[{i},{j}]": value for j, value in enumerate(row, start=1)}
    found = simulated(
        built("joint", version),
        "ModelExchange",
        last,
        signals(time, flange_a__tau=2.0 * np.sin(75.0 * time), flange_b__tau=np.full(time.size, load)),
        (*MOTION, "elastic_energy", "dissipated_energy"),
        values,
        relative_tolerance=1e-9,
    )
    exact, _ = reference(
        drive,
        last,
        [found[n][0] for n in MOTION],
        lambda t: 2.0 * math.sin(75.0 * t),
        load,
        CHAIN["mesh_damping"],
        CHAIN["series_compliance"],
    )
    wanted = exact(found["time"])
    for name, values in zip(MOTION, wanted, strict=True):
        assert np.abs(found[name] - values).max() < 1e-3 * np.ptp(values)
    assert found["elastic_energy"].min() < 1e-6 < 1e-3 < found["elastic_energy"].max()
    kinetic = 0.5 * 1e-3 * found["flange_a.w"] ** 2 + 0.5 * ARM * found["flange_b.w"] ** 2
    stored = kinetic + found["elastic_energy"] + found["dissipated_energy"]
    turned, swung = exact(time)[0], exact(time)[2]
    done = np.trapezoid(2.0 * np.sin(75.0 * time), turned) + load * np.ptp(swung[[0, -1]]) * np.sign(
        swung[-1] - swung[0]
    )
    assert stored[-1] - stored[0] == pytest.approx(done, rel=5e-3)


@pytest.mark.parametrize("version", ["2.0", "3.0"])
def test_kinematic_gives_in_model_exchange_what_it_gives_in_co_simulation(built, version):
    """Through reversals, zero torque and friction: where both are asked, both have seen the same."""
    time = np.linspace(0.0, 0.2, 201)
    inputs = signals(
        time,
        flange_a__phi=2.0 * np.sin(30.0 * time),
        flange_a__w=60.0 * np.cos(30.0 * time),
        flange_b__tau=40.0 * np.sin(50.0 * time + 0.3),
    )
    outputs = ("flange_b.phi", "flange_b.w", "flange_a.tau", "transmission_error", "power_loss")
    for friction in (0.0, 5.0):
        exchange, simulation = (
            simulated(built("kinematic", version), kind, 0.2, inputs, outputs, {"friction_torque": friction}, **more)
            for kind, more in (("ModelExchange", {}), ("CoSimulation", {"step_size": 1e-3}))
        )
        # A step takes the inputs of its beginning.
        for name in outputs:
            a = np.interp(time[5:-5], exchange["time"], exchange[name])
            b = simulation[name][6:-4]
            assert np.abs(a - b).max() < 1e-9 * max(np.abs(b).max(), 1.0), name


def test_compliant_gives_in_model_exchange_what_it_gives_in_co_simulation(built):
    time = np.linspace(0.0, 0.1, 2001)
    deviation, rate = 2e-4 * np.sin(200.0 * time), 0.04 * np.cos(200.0 * time)
    inputs = signals(
        time,
        flange_a__phi=10.0 * time,
        flange_a__w=np.full(time.size, 10.0),
        flange_b__phi=-10.0 * time / 39.0 + deviation,
        flange_b__w=-10.0 / 39.0 + rate,
    )
    outputs = ("flange_a.tau", "flange_b.tau", "dissipated_energy", "elastic_energy")
    values = {"friction_torque": 8.0, "mesh_damping": 30.0}
    path = built("compliant", "3.0")
    exchange = simulated(path, "ModelExchange", 0.1, inputs, outputs, values, relative_tolerance=1e-6)
    simulation = simulated(path, "CoSimulation", 0.1, inputs, outputs, values, output_interval=5e-5)
    at = np.linspace(1e-3, 0.099, 99)
    for name in outputs:
        a, b = (np.interp(at, found["time"], found[name]) for found in (exchange, simulation))
        assert np.abs(a - b).max() < 0.01 * np.ptp(b), name


@pytest.mark.parametrize("kind", ["inertia", "joint"])
def test_inertias_give_in_model_exchange_what_they_give_in_co_simulation(built, kind):
    """With friction that sticks and slides, losses and impacts; the inputs are held constant from step to step."""
    values = {"friction_torque": 4.0, "mesh_damping": 40.0, "series_compliance": 5e-6, "flange_b.tau": 15.0}
    if kind == "joint":
        values |= {"flange_a.tau": 1.5}
    else:
        values |= {"flange_a.w": 0.0}
    outputs = (
        "flange_b.phi",
        "flange_b.w",
        "transmission_error",
        "elastic_energy",
        "dissipated_energy",
        "output_friction_strain[3]",
    )
    exchange, simulation = (
        simulated(built(kind), name, 0.06, None, outputs, values, output_interval=5e-4, **more)
        for name, more in (("ModelExchange", {"relative_tolerance": 1e-6}), ("CoSimulation", {"step_size": 5e-4}))
    )
    for name in outputs:
        a = np.interp(simulation["time"], exchange["time"], exchange[name])
        # Elements that slide are strained by 1 % of the presliding angle more than they can be.
        share = 0.02 if "strain" in name else 0.01
        assert np.abs(a - simulation[name]).max() <= share * np.ptp(simulation[name]) + 1e-12, name
    assert simulation["dissipated_energy"][-1] > 0.0 or kind == "inertia"


# --- derivatives ---


class Model:
    """An instance in fmpy, of Model Exchange in continuous-time mode or for steps; values by name."""

    def __init__(self, path, folder, slave=False, early=False, **values):
        described = fmpy.read_model_description(str(path))
        new = described.fmiVersion.startswith("3")
        kind = (FMU3Slave if slave else FMU3Model) if new else FMU2Model
        self.references = {v.name: v.valueReference for v in described.modelVariables}
        self.states = [d.variable.derivative.name for d in described.derivatives]
        self.rates = [d.variable.name for d in described.derivatives]
        self.inputs = [v.name for v in described.modelVariables if v.causality == "input"]
        self.outputs = [
            v.name for v in described.modelVariables if v.causality == "output" and v.type in ("Real", "Float64")
        ]
        self.fmi = kind(
            guid=described.guid or described.instantiationToken,
            unzipDirectory=fmpy.extract(str(path), unzipdir=str(folder)),
            modelIdentifier="CycloidDrive",
            instanceName="drive",
        )
        self.fmi.instantiate(**({"eventModeUsed": True, "earlyReturnAllowed": True} if early else {}))
        self._set, self._get = (
            (self.fmi.setFloat64, self.fmi.getFloat64) if new else (self.fmi.setReal, self.fmi.getReal)
        )
        self.put(values)
        if not new:
            self.fmi.setupExperiment(startTime=0.0)
        self.fmi.enterInitializationMode()
        self.fmi.exitInitializationMode()
        if early:
            self.fmi.updateDiscreteStates()
            self.fmi.enterStepMode()
        elif not slave:
            (self.fmi.updateDiscreteStates if new else self.fmi.newDiscreteStates)()
            self.fmi.enterContinuousTimeMode()

    def put(self, values):
        """Set inputs, parameters and states."""
        states = {n: v for n, v in values.items() if n in self.states}
        others = {n: v for n, v in values.items() if n not in states}
        if others:
            self._set([self.references[n] for n in others], list(others.values()))
        if states:
            x = (c_double * len(self.states))()
            self.fmi.getContinuousStates(x, len(x))
            for name, value in states.items():
                x[self.states.index(name)] = value
            self.fmi.setContinuousStates(x, len(x))

    def get(self, *names):
        return np.array(self._get([self.references[n] for n in names]))

    def directional(self, unknowns, knowns, seeds):
        ask = self.fmi.getDirectionalDerivative
        return np.array(ask([self.references[n] for n in unknowns], [self.references[n] for n in knowns], list(seeds)))


@pytest.fixture
def model(built, tmp_path):
    made = []

    def one(kind, version="3.0", slave=False, early=False, **values):
        folder = tmp_path / f"{kind} {len(made)}"
        made.append(Model(built(kind, version), folder, slave, early, **values))
        return made[-1]

    yield one
    for each in made:
        each.fmi.freeInstance()


@pytest.mark.parametrize("version", ["2.0", "3.0"])
def test_a_time_that_is_not_finite_is_refused(model, version):
    one = model("inertia", version)
    one.fmi.setTime(0.5)
    for time in (math.nan, math.inf, -math.inf):
        with pytest.raises(FMICallException):
            one.fmi.setTime(time)


MOVED = {"flange_a.phi": 1e-7, "flange_b.phi": 1e-9, "transmission_error": 1e-9, **dict.fromkeys(STRAINS, 1e-9)}


@pytest.mark.parametrize(
    ("kind", "version"), [(kind, "3.0") for kind in STATES] + [("joint", "2.0"), ("kinematic", "2.0")]
)
@pytest.mark.parametrize("deviation", [2.2e-4, -1.4e-4, 1e-6])
def test_directional_derivatives_are_those_of_differences(model, kind, version, deviation):
    """Pressed on either flank and in the play, with friction, losses and damping."""
    found = model(kind, version, series_compliance=1e-7, friction_torque=0.0 if kind == "kinematic" else 3.0)
    values = {"flange_a.phi": 0.3, "flange_a.w": 31.0}
    strains = dict(zip(STRAINS, (1e-4, -2e-4, 3e-4, 4e-3, -4e-4, 1e-6, -2e-6, 3e-6, 4e-5, -4e-6), strict=True))
    if kind == "kinematic":
        values |= {"flange_b.tau": 3e5 * deviation}
    elif kind in ("compliant", "rotor"):
        values |= {"flange_b.phi": 0.3 / -39.0 + deviation, "flange_b.w": 31.0 / -39.0 + 0.02, **strains}
    else:
        values |= {"transmission_error": deviation, "flange_b.w": 31.0 / -39.0 + 0.02, **strains, "flange_b.tau": 7.0}
    if kind == "rotor":
        values |= {"arm_inertia": 1.0, "motor_stiffness": 0.1, "motor_damping": 0.1}
    parameters = {} if kind == "kinematic" else {"mesh_damping": 25.0}
    found.put({**values, **parameters})
    knowns = [n for n in dict.fromkeys([*found.inputs, *found.states]) if n != "dissipated_energy"]
    unknowns = list(dict.fromkeys([*found.outputs, *found.rates]))
    for known in knowns:
        at = found.get(known)[0]
        step = MOVED.get(known, 1e-5)
        sides = []
        for sign in (-1.0, 1.0):
            found.put({known: at + sign * step})
            sides.append(found.get(*unknowns))
        found.put({known: at})
        wanted = (sides[1] - sides[0]) / (2.0 * step)
        told = found.directional(unknowns, [known], [1.0])
        size = np.maximum(np.abs(sides[0]), 1e-9)
        noise = 1e-6 * np.abs(wanted) + 2e-14 * size / step + 1e-9 * size
        bad = [(n, w, g) for n, w, g, e in zip(unknowns, wanted, told, noise, strict=True) if abs(w - g) > e]
        assert not bad, known


@pytest.mark.parametrize("kind", ["compliant", "joint"])
def test_adjoint_derivatives_are_the_transposed_ones(model, kind):
    found = model(kind)
    found.put(
        {"flange_a.phi": 0.3, "flange_b.phi": 0.3 / -39.0 + 2e-4}
        if kind == "compliant"
        else {"flange_a.phi": 0.3, "transmission_error": 2e-4}
    )
    knowns = [n for n in (*found.inputs, *found.states) if n != "dissipated_energy"]
    unknowns, random = [*found.outputs, *found.rates], np.random.default_rng(1)
    seeds = random.normal(size=len(unknowns))
    whole = np.array([found.directional(unknowns, [name], [1.0]) for name in knowns])
    adjoint = found.fmi.getAdjointDerivative(
        [found.references[n] for n in unknowns],
        [found.references[n] for n in knowns],
        list(seeds),
        len(knowns),
    )
    assert np.allclose(adjoint, whole @ seeds, rtol=1e-12)
    mixed = random.normal(size=len(knowns))
    together = found.directional(unknowns, knowns, mixed)
    # Derivatives by differences are linear to their accuracy.
    assert np.allclose(together, mixed @ whole, rtol=1e-5, atol=1e-9 * np.abs(whole).max())


def test_in_co_simulation_derivatives_are_those_at_the_step_made(model):
    found = model("kinematic", slave=True, **{"flange_a.phi": 0.3, "flange_a.w": 5.0, "flange_b.tau": 40.0})
    found.fmi.doStep(0.0, 1e-3)
    unknowns = ["flange_b.phi", "flange_a.tau", "flange_b.w"]
    told = found.directional(unknowns, ["flange_b.tau"], [1.0])
    sides = []
    for torque in (40.0 - 1e-4, 40.0 + 1e-4):
        found.put({"flange_b.tau": torque})
        found.fmi.doStep(1e-3, 1e-3)
        sides.append(found.get(*unknowns))
    assert told == pytest.approx((sides[1] - sides[0]) / 2e-4, rel=1e-6)
    assert told[0] == pytest.approx(1.0 / found.get("torsional_stiffness")[0], rel=1e-6)
    # Inertias inside move only in the step.
    still = model("joint", slave=True)
    assert (still.directional(["flange_b.phi", "flange_b.w"], ["flange_b.tau"], [1.0]) == 0.0).all()
    alone = model("rotor", slave=True)
    of_arm = alone.directional(
        ["flange_a.phi", "flange_b.tau", "arm_angle", "transmission_error"], ["flange_b.phi"], [1.0]
    )
    assert of_arm.tolist() == [0.0, 0.0, 0.0, 1.0]


def test_a_derivative_by_an_output_is_refused(model):
    with pytest.raises(FMICallException):
        model("joint").directional(["flange_b.a"], ["elastic_energy"], [1.0])


# --- modes and states ---


def test_modes_are_kept_apart(model):
    found = model("joint")
    x = (c_double * len(found.states))()
    for refused in (
        lambda: found.fmi.updateDiscreteStates(),
        lambda: found.fmi.getContinuousStates(x, 3),
        lambda: found.put({"flange_b.a": 1.0}),
    ):
        with pytest.raises(FMICallException):
            refused()
    found.fmi.enterEventMode()
    found.fmi.updateDiscreteStates()
    found.fmi.enterContinuousTimeMode()
    other = model("joint", slave=True)
    for refused in (lambda: other.fmi.enterEventMode(), lambda: other.fmi.getContinuousStates(x, len(x))):
        with pytest.raises((FMICallException, AttributeError)):
            refused()


@pytest.mark.parametrize("kind", ["kinematic", "joint"])
def test_a_state_of_model_exchange_comes_back_with_its_mode_and_memory(model, kind):
    found = model(kind)
    torque = {"flange_b.tau": 10.0}
    found.put({**torque, "flange_a.phi": 0.2} if kind == "kinematic" else {**torque, "transmission_error": 1e-4})
    found.fmi.completedIntegratorStep()
    before = found.get(*found.outputs)
    kept = found.fmi.serializeFMUState(found.fmi.getFMUState())
    found.put({"flange_b.tau": 0.0, "flange_a.phi": 0.9})
    found.fmi.completedIntegratorStep()
    assert not np.array_equal(found.get(*found.outputs), before)
    found.fmi.setFMUState(found.fmi.deserializeFMUState(kept))
    assert np.array_equal(found.get(*found.outputs), before)
    other = model(kind, slave=True)
    with pytest.raises(FMICallException):
        other.fmi.deserializeFMUState(kept)


def test_a_trial_step_of_the_solver_leaves_no_mark_on_the_kinematic_play(model):
    """At zero torque the output rests until a flank drives it: the ends of steps count."""
    found = model("kinematic")
    found.put({"flange_b.tau": 0.0, "flange_a.phi": 0.0})
    found.fmi.completedIntegratorStep()
    (start,) = found.get("flange_b.phi")
    found.put({"flange_a.phi": 3.0})
    assert found.get("flange_b.phi")[0] != start
    found.put({"flange_a.phi": 0.0})
    assert found.get("flange_b.phi")[0] == start
    found.put({"flange_a.phi": 3.0})
    found.fmi.completedIntegratorStep()
    found.put({"flange_a.phi": 0.0})
    assert found.get("flange_b.phi")[0] != start


def test_elements_of_friction_stick_slide_and_turn_round_as_stops_do(built):
    """Against a stop's own formula: strain = clip(strain + way), each with its share of the presliding angle."""
    time = np.linspace(0.0, 0.2, 401)
    way = 3e-5 * np.sin(60.0 * time) + 2e-5 * np.sin(130.0 * time)
    speed = 1.8e-3 * np.cos(60.0 * time) + 2.6e-3 * np.cos(130.0 * time)
    names = STRAINS[5:]
    found = simulated(
        built("compliant"),
        "ModelExchange",
        0.2,
        signals(time, flange_b__phi=way, flange_b__w=speed),
        names,
        {"friction_torque": 3.0},
        relative_tolerance=1e-6,
        output_interval=5e-4,
    )
    fine, limits = np.linspace(0.0, 0.2, 40001), 2e-5 * np.arange(1, 6) / 5
    strains = [np.zeros(5)]
    for step in np.diff(np.interp(fine, time, way)):
        strains.append(np.clip(strains[-1] + step, -limits, limits))
    for name, wanted, limit in zip(names, np.transpose(strains), limits, strict=True):
        wanted = np.interp(found["time"], fine, wanted)
        assert np.abs(wanted).max() == pytest.approx(limit)
        assert np.abs(found[name] - wanted).max() < 1e-6


# --- steps that end at an event ---


def test_a_step_returns_early_at_an_impact_where_the_host_asks_for_it(model, built):
    """The drive turns through its play under torques that press it from flank to flank."""
    found = model("joint", slave=True, early=True, **{"flange_b.tau": 20.0})
    found.put({"flange_b.tau": -60.0})
    time, early = 0.0, []
    while time < 0.02:
        needed, terminate, returned, reached = found.fmi.doStep(time, 5e-3)
        assert not terminate
        assert returned == (reached < time + 5e-3 - 1e-12)
        assert needed or not returned  # in the last sub-step an impact ends a whole step
        if needed:
            early.append((reached, *found.get("elastic_energy", "transmission_error")))
            found.fmi.enterEventMode()
            found.fmi.updateDiscreteStates()
            found.fmi.enterStepMode()
        time = reached
    assert early
    # Contact has just begun: within a sub-step of the other flank.
    _, energy, deviation = early[0]
    assert 0.0 < energy < 1e-3
    assert -2.2e-4 < deviation < -1e-4
    # Without a request for an early return the step is complete.
    other = model("joint", slave=True, **{"flange_b.tau": 20.0})
    other.put({"flange_b.tau": -60.0})
    for i in range(4):
        assert other.fmi.doStep(5e-3 * i, 5e-3)[2:] == (False, pytest.approx(5e-3 * (i + 1)))


def test_fmpy_runs_a_joint_with_event_mode_and_early_return(built):
    whole, early = (
        simulated(
            built("joint", "3.0"),
            "CoSimulation",
            0.02,
            None,
            ("flange_b.phi",),
            {"flange_b.tau": -30.0, "flange_a.tau": 2.0},
            use_event_mode=used,
            early_return_allowed=used,
        )
        for used in (False, True)
    )
    values = np.interp(whole["time"], early["time"], early["flange_b.phi"])
    assert np.abs(values - whole["flange_b.phi"]).max() < 1e-3 * np.ptp(whole["flange_b.phi"])


def test_fmuloader_exchanges_the_model(built, model):
    from fmuloader.fmi3 import Fmi3Slave

    path, beside = built("joint", "3.0"), model("joint", **{"flange_b.tau": 20.0})
    host = Fmi3Slave(str(path), model_identifier="CycloidDrive")
    token = fmpy.read_model_description(str(path)).instantiationToken
    host.instantiate_model_exchange("drive", instantiation_token=token)
    host.set_float64([beside.references["flange_b.tau"]], [20.0])
    host.enter_initialization_mode(start_time=0.0)
    host.exit_initialization_mode()
    host.update_discrete_states()
    host.enter_continuous_time_mode()
    count = host.get_number_of_continuous_states()
    x = np.array(host.get_continuous_states(count))
    x[beside.states.index("transmission_error")] = 1.5e-4
    host.set_continuous_states(list(x))
    beside.put({"transmission_error": 1.5e-4})
    assert list(host.get_continuous_state_derivatives(count)) == list(beside.get(*beside.rates))
    names = [f"event_indicator[{i}]" for i in range(1, 6)]
    assert list(host.get_event_indicators(host.get_number_of_event_indicators())) == list(beside.get(*names))
    host.terminate()
    host.free_instance()
