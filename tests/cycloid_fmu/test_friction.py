"""Friction as stated: files, measured losses, the command."""

import math

import fmpy
import numpy as np
import pytest
from common import CASES, EXAMPLES
from fmpy.validation import validate_fmu
from typer.testing import CliRunner

import cycloid_fmu as cy
from cycloid_fmu.cli import app
from cycloid_fmu.fmu.bench_losses import fitted_losses
from cycloid_fmu.fmu.friction_file import read_friction

TABLE = ((0.0, 0.9, 0.85, 0.02, 0.03), (50.0, 0.92, 0.87, 0.03, 0.04), (300.0, 0.95, 0.9, 0.06, 0.06))
BENCH = "speed [rpm],torque [N*m],loss [N*m],temperature [K]\n"


def lost_torque(speed, torque):
    """The loss table of Modelica's LossyGear at one of its speeds, far from where the power turns round."""
    ((_, forward, backward, friction_forward, friction_backward),) = [row for row in TABLE if row[0] == speed]
    if torque > 0.0:
        return (torque + friction_forward) / forward - torque
    return backward * (torque + friction_backward) - torque


def measured(warm=0.0, noise=0.0):
    """Losses of a table at its speeds, under torques of both signs, cold and warm."""
    random, rows = np.random.default_rng(4), []
    for speed, torque, temperature in np.stack(
        np.meshgrid([0.0, 50.0, 300.0], [-4.0, -2.0, -0.5, 0.5, 2.0, 4.0], [290.0, 320.0]), axis=-1
    ).reshape(-1, 3):
        loss = lost_torque(speed, torque) * math.exp(-warm * (temperature - 305.0))
        rows.append((speed, torque, loss * (1.0 + noise * random.normal()), temperature))
    return np.array(rows).T


@pytest.mark.parametrize("warm", [0.0, 0.012])
def test_a_bench_s_losses_give_the_table_that_made_them(warm):
    found = fitted_losses(*measured(warm))
    assert found.temperature_coefficient == pytest.approx(warm, abs=1e-7)
    assert found.reference_temperature == pytest.approx(305.0)
    np.testing.assert_allclose(found.rows, TABLE, rtol=1e-5)
    assert found.misfit < 1e-6


def test_the_misfit_of_noisy_losses_is_their_noise():
    assert fitted_losses(*measured(0.01, 0.02)).misfit == pytest.approx(0.02, rel=0.4)


def bench_file(path, warm=0.01):
    rows = [f"{s * 30.0 / math.pi},{t * 39.0},{loss},{kelvin}" for s, t, loss, kelvin in measured(warm).T]
    path.write_text(BENCH + "\n".join(rows) + "\n")
    return path


def test_the_command_takes_measured_losses_and_a_friction_file(tmp_path):
    losses = bench_file(tmp_path / "bench.csv")
    out = tmp_path / "d.fmu"
    words = ["build", str(CASES / "errors-39-40.toml"), "--losses", str(losses), "-o", str(out)]
    friction = tmp_path / "friction.toml"
    friction.write_text((EXAMPLES / "friction.toml").read_text().replace("temperature_coefficient", "# "))
    done = CliRunner().invoke(app, [*words, "--friction", str(friction)])
    assert done.exit_code == 0, done.output
    assert "% of the losses (rms), proportional to exp(-0.01/K (T - 305 K))" in done.output
    variables = {v.name: v for v in fmpy.read_model_description(str(out)).modelVariables}
    start = {name: float(v.start) for name, v in variables.items() if v.start not in (None, "false", "true")}
    assert start["loss_table[2,2]"] == pytest.approx(0.92, rel=1e-4)
    assert start["input_friction.coulomb"] == 0.02
    assert start["friction_torque"] == 2.0
    assert start["output_friction.load_share"] == 0.02
    assert start["input_friction.temperature_coefficient"] == pytest.approx(0.01, rel=1e-4)
    assert variables["temperature"].causality == "input"
    assert variables["temperature"].unit == "K"
    assert validate_fmu(str(out)) == []
    twice = CliRunner().invoke(app, [*words, "--friction", str(EXAMPLES / "friction.toml")])
    assert twice.exit_code == 1
    assert "temperature_coefficient = 0.015 1/K" in str(twice.exception or twice.output)


def test_without_a_temperature_law_there_is_no_such_input(tmp_path):
    cy.Drive(cy.read_drive(CASES / "errors-39-40.toml").pair).build_fmu(tmp_path / "d.fmu")
    names = {v.name for v in fmpy.read_model_description(str(tmp_path / "d.fmu")).modelVariables}
    assert not {n for n in names if "temperature" in n}
    assert {"input_friction.coulomb", "output_friction.load_share", "output_friction.presliding_angle"} <= names


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ('coulomb = "-1 N*m"', "coulomb = .*greater than or equal to 0"),
        ("load_share = 1.2", r"load_share = 1\.2.*0\.9"),
        ('viscous = "1 N*m"', "viscous"),
        ('stribek = "1 N*m"', "stribeck"),
        ('presliding_angle = "0 rad"', "presliding_angle"),
    ],
)
def test_friction_that_is_none_is_refused_in_a_sentence(tmp_path, line, said):
    path = tmp_path / "friction.toml"
    path.write_text(f'format = "cycloid-friction/1"\n[friction.output]\n{line}\n')
    with pytest.raises(cy.InputError, match=rf"friction\.toml: .*{said}"):
        read_friction(path)


@pytest.mark.parametrize(
    ("rows", "said"),
    [("", "needs measured points"), ("10,1,0.2,300\n", "fewer than two torques"), ("10,1,x,300\n", "line 2")],
)
def test_measured_losses_that_give_no_table_are_refused_in_a_sentence(tmp_path, rows, said):
    path = tmp_path / "bench.csv"
    path.write_text(BENCH + rows)
    done = CliRunner().invoke(
        app, ["build", str(CASES / "errors-39-40.toml"), "--losses", str(path), "-o", str(tmp_path / "d.fmu")]
    )
    assert done.exit_code == 1
    assert said in str(done.exception or done.output)
