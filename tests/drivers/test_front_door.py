"""The names for notebooks: import time, completeness, and errors that name the bad argument."""

import subprocess
import sys

import pytest

import drivers
from cycloid_fmu import edge
from drivers.simulated.buses import SimulatedCan

COST = """
import time
begun = time.perf_counter()
import drivers
cost = time.perf_counter() - begun
import sys
print(cost, *{name.partition(".")[0] for name in sys.modules})
"""


@pytest.mark.system
def test_importing_is_fast_and_loads_no_library():
    def measured():
        run = subprocess.run([sys.executable, "-c", COST], capture_output=True, text=True, check=True)
        seconds, *loaded = run.stdout.split()
        return float(seconds), set(loaded)

    runs = [measured() for _ in range(3)]
    assert min(seconds for seconds, _ in runs) < 0.1
    assert not runs[0][1] & {"numpy", "numba", "pyarrow", "can", "canopen", "serial", "pydantic", "pint", "typer"}


def test_the_front_door_has_exactly_the_documented_names():
    assert len(drivers.__all__) <= 18  # what a notebook needs, and the four simulated buses that simulate_bench takes
    assert set(drivers.__all__) <= set(dir(drivers))
    for name in drivers.__all__:
        assert getattr(drivers, name).__doc__
    with pytest.raises(AttributeError, match="no attribute 'recrod'"):
        _ = drivers.recrod


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"torque": 20.0}, "ratio is missing"),
        ({"torque": "20 mm", "ratio": -39}, 'torque = "20 mm": the unit "mm" measures something else'),
        ({"torque": 20.0, "ratio": 0.0}, "ratio = 0.0: write the signed ratio"),
        (
            {"torque": 20.0, "ratio": -39, "motion": drivers.SimulatedMotion(speed=0.0)},
            "speed = 0.0: it must be above 0",
        ),
        (
            {"torque": 20.0, "ratio": -39, "motion": drivers.SimulatedMotion(noise="-1 arcsec")},
            'noise = "-1 arcsec": it must not be below 0',
        ),
    ],
)
def test_errors_name_the_argument(arguments, said):
    with pytest.raises(edge.ArgumentError, match=said):
        drivers.simulate_bench(**arguments)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"trigger": "morse"}, 'trigger = "morse"'),
        ({"interface": "socketcan", "clock_drift": 1e-4}, "clock_drift: only the buses"),
        ({"speed_factor": 0.0}, "speed_factor = 0.0"),
    ],
)
def test_a_contradictory_bus_names_the_key(arguments, said):
    with pytest.raises(edge.InputError, match=said):
        SimulatedCan(**arguments)


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda path: drivers.record(path, "run.arrows", duration="-1 s"), 'duration = "-1 s": it must be above 0'),
        (lambda path: drivers.record(path, "run.arrows", idle="2"), 'idle = "2": write one number'),
        (lambda path: drivers.export(path, "run.xls"), "output = run.xls: the name must end in"),
        (lambda path: drivers.watch(path, host="nowhere"), 'host = "nowhere": write an address'),
    ],
)
def test_errors_name_the_argument_of_files(tmp_path, call, said):
    with drivers.simulate_bench(ratio=-39, torque=20.0, turns=1, bus="virtual") as bench:
        wiring = bench.write_wiring(tmp_path / "BENCH.toml")
        with pytest.raises(edge.ArgumentError, match=said):
            call(wiring)
