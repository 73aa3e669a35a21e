"""Uncertainty budgets after GUM, and a Monte Carlo of the whole measurement (JCGM 101) and GUM's own example."""

import json
import math

import numpy as np
import pytest
from test_loop_drift import COULOMB, RATED, steady, swung, wound
from test_metrics import run_with, started_at

import fitting
from cycloid_fmu import edge
from fitting.figures.budget import Budget, Contribution
from fitting.figures.instruments import Encoder, Instruments, Thermometer, TorqueSensor, read_instruments

ARCSEC = np.pi / 648000
STATED = """format = "cycloid-instruments/1"
[instruments.output_encoder]
name = "RON 905"
serial_number = "4711"
calibrated = 2026-03-01
accuracy = "1 arcsec"
subdivision = "0.8 arcsec"
periods_per_turn = 1500
run_out = "0.5 arcsec"
[instruments.torque_sensor]
range = "200 N*m"
accuracy_class = 0.5
zero = "0.4 N*m"
[instruments.thermometer]
limit = "2 K"
[instruments.thermometer.coefficients]
backlash = "0.1 arcsec/K"
"""


def test_combination_is_that_of_the_guide_s_example():
    """JCGM 100:2008, H.1: an end gauge of 32 nm with 16.7 effective degrees of freedom."""
    rows = ((25.0, 18.0), (9.7, 25.6), (2.9, 50.0), (16.6, 2.0))
    budget = Budget("gauge", 0.0, "rad", tuple(Contribution("", "B", "", u, "rad", 1.0, v) for u, v in rows))
    assert budget.standard_uncertainty == pytest.approx(32.0, abs=0.5)
    assert budget.degrees == pytest.approx(16.7, abs=0.6)
    assert budget.coverage_factor == pytest.approx(2.12, abs=0.01)  # Student's t of 16 (table G.2)
    assert budget.expanded == budget.coverage_factor * budget.standard_uncertainty


@pytest.fixture(scope="module")
def stated(tmp_path_factory):
    path = tmp_path_factory.mktemp("bench") / "bench.toml"
    path.write_text(STATED)
    return path


@pytest.mark.slow(3)
def test_a_loop_s_budget_covers_a_monte_carlo_of_the_bench(stated):
    """Errors drawn from the instruments as they are stated, on the raw recording, each draw with noise of its own."""
    torque = swung([1, -1])
    true = wound(torque, 0.5, COULOMB) * 60.0 * ARCSEC
    truth = steady(0.5, COULOMB)
    random, draws = np.random.default_rng(5), 60
    errors, inside, budgets = {n: [] for n in truth}, dict.fromkeys(truth, 0), {n: [] for n in truth}
    for draw in range(draws):
        at = true + random.uniform(0.0, 2.0 * np.pi)
        phase = random.uniform(0.0, 2.0 * np.pi, 2)
        read = at + 0.8 * ARCSEC * np.cos(1500 * at + phase[0]) + 0.5 * ARCSEC * np.cos(at + phase[1])
        x, y = random.uniform(-1.0, 1.0, 2) * ARCSEC
        read = read + x * np.cos(at) + y * np.sin(at) + random.normal(0.0, 0.3 * ARCSEC, at.size)
        shown = torque * (1.0 + random.uniform(-1.0, 1.0) * 0.005 * 200.0 / RATED) + random.uniform(-0.4, 0.4)
        run = fitting.Run(0.0, read, shown, time=0.01 * np.arange(at.size))
        drift = 2.0 * random.uniform(-1.0, 1.0)  # K, which affects only the backlash
        found = fitting.metrics(run, ratio=-39.0, rated_torque=RATED, instruments=stated if draw < 10 else None)
        for name, known in truth.items():
            error = found.figures[name].value - known + (drift * 0.1 * ARCSEC if name == "backlash" else 0.0)
            errors[name].append(error)
            budgets[name] += [found.budgets[name]] if draw < 10 else []
    for name, error in errors.items():
        stated_u = math.sqrt(np.mean([b.standard_uncertainty**2 for b in budgets[name]]))
        assert stated_u == pytest.approx(math.sqrt(np.mean(np.square(error))), rel=0.35), name
        inside[name] = np.count_nonzero(np.abs(error) <= np.mean([b.expanded for b in budgets[name]]))
        assert inside[name] >= 0.85 * draws, (name, inside)
    alone = np.count_nonzero(np.abs(errors["torsional_stiffness"]) <= found.figures["torsional_stiffness"].uncertainty)
    assert alone < 0.5 * draws


@pytest.mark.slow(1)
def test_the_budget_of_a_transmission_error_covers_a_monte_carlo():
    """Run-out of 1″ on the output and 30″ on the input: the figure without the rig's orders holds none of them."""
    own = {1: (6.0 * ARCSEC, 0.4), 39: (20.0 * ARCSEC, 1.0), 40: (9.0 * ARCSEC, 2.0)}
    encoders = Instruments(output_encoder=Encoder(run_out="1 arcsec"), input_encoder=Encoder(run_out="30 arcsec"))
    turn = np.linspace(0.0, 2.0 * np.pi, 40001)
    truth = np.ptp(sum(a * np.cos(k * turn - p) for k, (a, p) in own.items()))
    random, errors, stated = np.random.default_rng(1), [], []
    for draw in range(40):
        run = run_with(own, turns=1, each=1500, noise=0.3 * ARCSEC, seed=draw)
        phase = random.uniform(0.0, 2.0 * np.pi, 2)
        read = run.output_angle + 1.0 * ARCSEC * np.cos(run.output_angle + phase[0])
        seen = run.input_angle + 30.0 * ARCSEC * np.cos(run.input_angle + phase[1])
        made = fitting.Run(seen, read, 100.0, time=run.time)
        found = fitting.metrics(made, ratio=-39.0, instruments=encoders if draw < 4 else None)
        errors.append(found.figures["angular_transmission_error"].value - truth)
        if draw < 4:
            stated.append(found.budgets["angular_transmission_error"])
            rig = found.budgets["angular_transmission_error_without_rig"]
            # Run-out of the output is left out with the rig's orders; that of the input has the order of the pins.
            part = {one.source: one.contribution for one in rig.contributions}
            assert part["output encoder, run-out"] == 0.0
            assert part["input encoder, run-out"] > 0.0
    combined = np.mean([b.standard_uncertainty for b in stated])
    assert combined == pytest.approx(np.sqrt(np.mean(np.square(errors))), rel=0.35)
    assert np.count_nonzero(np.abs(errors) <= np.mean([b.expanded for b in stated])) >= 34


def test_repeatability_brings_its_degrees_of_freedom():
    """Three loops that differ by 2″ each: two degrees, k = 4.30, until the instruments outweigh them."""
    torque = np.tile(swung([1, -1])[:-1], 3)
    windup = np.tile(wound(swung([1, -1])[:-1], 0.5, COULOMB), 3) * 60.0 * ARCSEC
    wider = np.sign(torque) * np.repeat([0.0, 3.0, -1.0], torque.size // 3) * ARCSEC / 2
    run = fitting.Run(0.0, windup + wider, torque, time=0.01 * np.arange(torque.size))
    for limit, low, high in ((0.0, 4.2, 4.31), (200.0, 1.95, 2.1)):
        bench = Instruments(
            output_encoder=Encoder(resolution=1e-9 * ARCSEC),
            thermometer=Thermometer(limit="1 K", coefficients={"hysteresis_loss": f"{limit} arcsec/K"}),
        )
        found = fitting.metrics(run, ratio=-39.0, rated_torque=RATED, instruments=bench)
        budget = found.budgets["hysteresis_loss"]
        (repeated,) = (row for row in budget.contributions if row.kind == "A")
        assert repeated.degrees == 2.0
        assert repeated.contribution == pytest.approx(4.0 * ARCSEC / np.sqrt(12.0) * 1.0408, rel=0.1)
        assert low < budget.coverage_factor < high


def test_temperature_and_torque_sensor_enter_as_they_are_stated():
    torque = swung([1, -1])
    run = fitting.Run(0.0, wound(torque, 0.5, COULOMB) * 60.0 * ARCSEC, torque, time=0.01 * np.arange(torque.size))
    bench = Instruments(
        torque_sensor=TorqueSensor(range="200 N*m", accuracy_class=0.1),
        thermometer=Thermometer(limit="2 K", coefficients={"backlash": "0.5 arcsec/K"}),
    )
    found = fitting.metrics(run, ratio=-39.0, rated_torque=RATED, instruments=bench)
    row = found.budgets["backlash"].contributions[-1]
    assert row.contribution == pytest.approx(2.0 / math.sqrt(3.0) * 0.5 * ARCSEC)
    stiffness = found.budgets["torsional_stiffness"]
    (gain,) = (one for one in stiffness.contributions if one.source.startswith("torque sensor"))
    # The share of the torque is that of the stiffness.
    assert gain.contribution == pytest.approx(stiffness.value * 0.001 * 200.0 / RATED / math.sqrt(3.0), rel=0.02)


def test_budgets_in_the_terminal_the_file_and_the_report(command, tmp_path):
    torque = swung([1, -1])
    windup = wound(torque, 0.5, COULOMB) * 60.0
    rows = "\n".join(f"{0.01 * n:.2f},0,{w:.6f},{t:.6f}" for n, (w, t) in enumerate(zip(windup, torque, strict=True)))
    (tmp_path / "loop.csv").write_text(f"time [s],input_angle [deg],output_angle [arcsec],torque [N*m]\n{rows}\n")
    (tmp_path / "bench.toml").write_text(STATED)
    words = ("loop.csv", "--rated-torque", "167 N*m", "--instruments", "bench.toml", "-o")
    run = command("cycloid-fit", "metrics", *words, "f.json")
    assert run.returncode == 0, run.stderr
    assert "Uncertainty budget of lost_motion" in run.stdout
    stated = json.loads((tmp_path / "f.json").read_text())["lost_motion"]["budget"]
    rows = stated["contributions"]
    assert stated["combined_standard_uncertainty"] == pytest.approx(math.hypot(*(r["contribution"] for r in rows)))
    assert {r["type"] for r in rows} == {"A", "B"}
    run = command("cycloid-fit", "compare", "f.json", "f.json")
    assert run.returncode == 0, run.stderr
    run = command("cycloid-fit", "report", *words, "r.html")
    assert run.returncode == 0, run.stderr
    page = (tmp_path / "r.html").read_text(encoding="utf-8")
    assert page.count("<h2>Uncertainty budget (JCGM 100:2008): ") == 4
    assert "output encoder, subdivision" in page


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('accuracy = "1 arcsec"', 'accuracy = "-1 arcsec"', "[instruments.output_encoder] accuracy"),
        ('accuracy = "1 arcsec"', "accuracy = 1", "[instruments.output_encoder] accuracy = 1"),
        ("periods_per_turn = 1500\n", "", "subdivision needs periods_per_turn"),
        ("accuracy_class = 0.5", "accuracy_class = 200", "accuracy_class = 200"),
        ("backlash =", "play =", "play is not a figure"),
        ("0.1 arcsec/K", "0.1 mm/K", "backlash"),
        ("2026-03-01", '"last spring"', "calibrated"),
        ("[instruments.thermometer]", "[instruments.barometer]", "barometer"),
    ],
)
def test_bad_instruments_are_one_sentence(tmp_path, old, new, said):
    (tmp_path / "bench.toml").write_text(STATED.replace(old, new))
    with pytest.raises(edge.InputError) as caught:
        read_instruments(tmp_path / "bench.toml")
    assert said in str(caught.value)
    assert "bench.toml" in str(caught.value)


def test_starts_are_readings_of_a_torque_sensor_and_one_start_has_no_budget():
    """Class 1 of 5 N·m: 50 mN·m at the range, in proportion below."""
    bench = Instruments(torque_sensor=TorqueSensor(range="5 N*m", accuracy_class=1.0, zero="10 mN*m"))
    for levels in ((3.0,), (3.0, 4.0, 5.0)):
        angle, torque = started_at(levels)
        run = fitting.Run(angle, angle / -39, torque, time=1e-3 * np.arange(torque.size))
        found = fitting.metrics(run, ratio=-39.0, instruments=bench)
        assert ("back_driving_torque" in found.budgets) == (len(levels) > 1)
    repeated, share, zero = found.budgets["back_driving_torque"].contributions
    assert repeated.contribution == pytest.approx(1.0 / math.sqrt(3.0))
    assert repeated.degrees == 2.0
    assert share.contribution == pytest.approx(0.01 * 4.0 / math.sqrt(3.0))
    assert zero.contribution == pytest.approx(0.01 / math.sqrt(3.0))


def test_a_graduation_s_error_is_in_the_figure_without_the_rig_s_orders_too():
    """±1″ of a graduation may lie at an order that is not left out, run-out may not."""
    run = run_with({1: (6.0 * ARCSEC, 0.4), 40: (9.0 * ARCSEC, 2.0)}, turns=1, each=1500, noise=0.1 * ARCSEC, seed=0)
    made = fitting.Run(run.input_angle, run.output_angle, 100.0, time=run.time)
    for encoder, counts in ((Encoder(accuracy="1 arcsec"), True), (Encoder(run_out="1 arcsec"), False)):
        found = fitting.metrics(made, ratio=-39.0, instruments=Instruments(output_encoder=encoder))
        wave = found.budgets["angular_transmission_error_without_rig"].contributions[1]
        # Of 40 equal peaks one is near the wave's top: twice the amplitude, whose mean square is that of both parts.
        known = 2.0 * np.sqrt(2.0) * wave.standard_uncertainty if counts else 0.0
        assert wave.contribution == pytest.approx(known, rel=0.05)


def test_a_long_loop_s_sensitivities_are_found_with_fewer_samples(monkeypatch):
    torque = swung([1, -1, 1])
    run = fitting.Run(0.0, wound(torque, 0.5, COULOMB) * 60.0 * ARCSEC, torque, time=0.01 * np.arange(torque.size))
    encoder = Encoder(subdivision="0.8 arcsec", periods_per_turn=1500)
    bench = Instruments(output_encoder=encoder, torque_sensor=TorqueSensor(range="200 N*m", accuracy_class=0.5))
    found = [fitting.metrics(run, ratio=-39.0, rated_torque=RATED, instruments=bench).budgets]
    monkeypatch.setattr("fitting.figures.budget._SAMPLES", 1000)
    found.append(fitting.metrics(run, ratio=-39.0, rated_torque=RATED, instruments=bench).budgets)
    for name, budget in found[0].items():
        assert found[1][name].standard_uncertainty == pytest.approx(budget.standard_uncertainty, rel=0.1), name


def test_a_step_of_the_encoder_is_that_of_its_readings():
    """Lost motion is half the sum of four readings with signs: one step of 1″ leaves 1/√12″; hysteresis loss two."""
    torque = swung([1, -1])
    run = fitting.Run(0.0, wound(torque, 0.5, COULOMB) * 60.0 * ARCSEC, torque, time=0.01 * np.arange(torque.size))
    bench = Instruments(output_encoder=Encoder(resolution="1 arcsec"), input_encoder=Encoder(resolution="1 arcsec"))
    budgets = fitting.metrics(run, ratio=-39.0, rated_torque=RATED, instruments=bench).budgets
    for name, readings in (("lost_motion", 1.0), ("hysteresis_loss", math.sqrt(2.0)), ("backlash", math.sqrt(3.0))):
        output, given = budgets[name].contributions[1:]
        assert output.contribution == pytest.approx(readings / math.sqrt(12.0) * ARCSEC)
        assert given.contribution == pytest.approx(output.contribution / 39.0)
    stiffness, (_, output, _) = budgets["torsional_stiffness"].value, budgets["torsional_stiffness"].contributions
    # The windup between half and whole rated torque is the difference of two readings, on each of two sides.
    share = math.sqrt(2.0) / math.sqrt(12.0) * ARCSEC / (0.5 * RATED / stiffness) / math.sqrt(2.0)
    assert output.contribution == pytest.approx(stiffness * share)
