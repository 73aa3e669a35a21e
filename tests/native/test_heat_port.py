"""The heat capacity of a native FMU: as in Python, in Co-Simulation and Model Exchange, and its derivatives."""

import fmpy
import numpy as np
import pytest
from clockworks import Drive
from common import EXAMPLES
from fmpy.fmi3 import FMU3Model

import cycloid_fmu as cy
from cycloid_fmu.fmu.build import completed
from cycloid_fmu.fmu.library import this_platform
from cycloid_fmu.fmu.native import build_native
from cycloid_fmu.fmu.variables import Interface

LOSSES = ((0.0, 0.9, 0.88, 0.05, 0.05), (50.0, 0.93, 0.92, 0.1, 0.12), (800.0, 0.94, 0.93, 0.6, 0.7))
SPEED, LOAD, LAST = 120.0, 100.0, 900.0


def of(kind, **more):
    """An interface with losses by viscosity and a small heat capacity."""
    pair = cy.read_drive(EXAMPLES / "drive-39-40-bearings.toml").pair
    thermal = pair.thermal.replace(capacity=300.0)
    return Interface(kind, losses=LOSSES, lubricant=pair.losses.lubricant, thermal=thermal, **more)


@pytest.fixture(scope="module")
def fmus(drive, tmp_path_factory):
    """Native FMUs by interface."""
    folder = tmp_path_factory.mktemp("heat")
    kinds = {"kinematic": of("kinematic"), "joint": of("compliant", output_inertia=2.0, crank_inertia=1e-3)}
    for name, interface in kinds.items():
        build_native(
            drive,
            folder / f"{name}.fmu",
            interface=interface,
            fmi_version="3.0",
            drive_tables=drive.tables,
            platforms=[this_platform()],
        )
    return {name: folder / f"{name}.fmu" for name in kinds}


def driven():
    time = np.linspace(0.0, LAST, 451)
    inputs = np.zeros(time.size, [(n, "f8") for n in ("time", "flange_a.phi", "flange_a.w", "flange_b.tau")])
    inputs["time"], inputs["flange_a.phi"], inputs["flange_a.w"], inputs["flange_b.tau"] = (
        time,
        SPEED * time,
        SPEED,
        LOAD,
    )
    return inputs


def test_co_simulation_model_exchange_and_python_warm_up_alike(drive, fmus):
    settings = {"stop_time": LAST, "input": driven(), "output": ["heat_port.T", "power_loss"], "output_interval": 2.0}
    stepped = fmpy.simulate_fmu(str(fmus["kinematic"]), fmi_type="CoSimulation", step_size=2.0, **settings)
    solved = fmpy.simulate_fmu(str(fmus["kinematic"]), fmi_type="ModelExchange", **settings)
    assert stepped["heat_port.T"][-1] > 310.0
    assert solved["heat_port.T"] == pytest.approx(stepped["heat_port.T"], abs=0.2)
    clock = Drive(drive, completed(of("kinematic"), drive))
    clock.crank_speed, clock.torque = SPEED, LOAD
    clock.advance()
    for time in settings["input"]["time"][:-1]:
        clock.crank_angle = SPEED * time
        clock.advance(2.0)
    assert clock.clockwork.get("heat_port.T") == pytest.approx(stepped["heat_port.T"][-1], abs=0.1)


def test_energy_is_dissipated_into_the_capacity(fmus):
    """Without surroundings C (T - T_start) is the energy dissipated, with two inertias inside."""
    values = {"thermal_resistance": 1e12, "flange_b.tau": -20.0, "flange_a.tau": 2.0, "heat_capacity": 50.0}
    for kind in ("CoSimulation", "ModelExchange"):
        run = fmpy.simulate_fmu(
            str(fmus["joint"]),
            fmi_type=kind,
            stop_time=0.2,
            output_interval=1e-3,
            start_values=values,
            output=["heat_port.T", "dissipated_energy"],
        )
        lost = run["dissipated_energy"] - run["dissipated_energy"][0]
        assert lost[-1] > 1.0
        assert 50.0 * (run["heat_port.T"] - run["heat_port.T"][0]) == pytest.approx(lost, rel=1e-4, abs=1e-4)


def test_the_rate_of_the_temperature_has_derivatives(fmus):
    """By the temperature of the surroundings and the heat flow: 1/(RC) and 1/C."""
    path = str(fmus["kinematic"])
    description = fmpy.read_model_description(path)
    assert [d.variable.derivative.name for d in description.derivatives] == ["heat_port.T"]
    reference = {v.name: v.valueReference for v in description.modelVariables}
    model = FMU3Model(
        guid=description.guid,
        unzipDirectory=fmpy.extract(path),
        modelIdentifier=description.modelExchange.modelIdentifier,
        instanceName="heat",
    )
    model.instantiate()
    model.enterInitializationMode()
    model.setFloat64([reference["flange_a.w"], reference["flange_b.tau"]], [SPEED, LOAD])
    model.exitInitializationMode()
    model.enterContinuousTimeMode()
    unknown = [reference["heat_port.T_rate"]]
    resistance, capacity = model.getFloat64([reference["thermal_resistance"], reference["heat_capacity"]])
    for name, expected in (
        ("ambient_temperature", 1.0 / (resistance * capacity)),
        ("heat_port.Q_flow", 1.0 / capacity),
    ):
        (slope,) = model.getDirectionalDerivative(unknown, [reference[name]], [1.0])
        assert slope == pytest.approx(expected, rel=1e-5)
    (slope,) = model.getDirectionalDerivative(unknown, [reference["heat_port.T"]], [1.0])
    assert slope < -1.0 / (resistance * capacity)  # thinner oil makes less heat
    model.terminate()
    model.freeInstance()
