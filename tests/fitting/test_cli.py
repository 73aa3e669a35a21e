import json

import numpy as np
import pytest
from common import BENCH


def test_identify_from_the_command_line(command, tmp_path):
    files = [BENCH / f"250Nm-{way}.csv" for way in ("forward", "backward")]
    run = command(
        "cycloid-fit", "identify", *files, "--pair", BENCH / "pair.toml", "-o", "fit.json", "--surface", "s.nc",
        "--plot", "fit.png",
    )  # fmt: skip
    assert run.returncode == 0, run.stderr
    assert "centre_distance_x" in run.stdout
    fit = json.loads((tmp_path / "fit.json").read_text())
    assert fit["parameters"]["eccentricity"]["value"] == pytest.approx(1.5e-6, abs=2e-7)
    assert len(fit["data"]) == 2
    assert (tmp_path / "fit.png").stat().st_size > 20000
    again = command("cycloid-fmu", "build", BENCH / "pair.toml", "--surface", "s.nc", "-o", "d.fmu")
    assert again.returncode == 0, again.stderr


def test_curve_from_the_command_line(command, tmp_path):
    run = command(
        "cycloid-fit", "curve", BENCH / "30Nm-forward.csv", "--pair", BENCH / "pair.toml", "-o", "c.nc", "--plot",
        "c.pdf", "--json",
    )  # fmt: skip
    assert run.returncode == 0, run.stderr
    curve = json.loads(run.stdout)
    assert np.mean(curve["torque"]) == pytest.approx(30.0, abs=0.05)
    assert len(curve["transmission_error"][0]) == 936
    assert (tmp_path / "c.pdf").read_bytes().startswith(b"%PDF")


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("", "empty"),
        ("time [s],input_angle [rad],output_angle [rad]\n0,0,0\n1,1,1\n", "no column"),
        ("time [s],input_angle [rad],output_angle [rad],torque [N*m]\n0,0,0,1\n1,nan,1,1\n", "sample 1"),
        ("time [s],input_angle [rad],output_angle [rad],torque [N*m]\n0,0,0,1\n1,1,1,1\n2,2,2,1\n", "check the pair"),
    ],
)
@pytest.mark.parametrize("verb", ["curve", "identify"])
def test_bad_recordings_exit_2_and_write_nothing(command, tmp_path, verb, content, said):
    (tmp_path / "run.csv").write_text(content)
    output = "c.nc" if verb == "curve" else "fit.json"
    run = command("cycloid-fit", verb, "run.csv", "--pair", BENCH / "pair.toml", "-o", output)
    assert run.returncode == 2
    assert said in run.stderr
    assert "run.csv" in run.stderr
    assert "Traceback" not in run.stderr
    assert [p.name for p in tmp_path.iterdir()] == ["run.csv"]
