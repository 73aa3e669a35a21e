import json
import signal

import numpy as np
import pytest
from common import BENCH

from fitting.transmission_error.survey import survey


def test_identify_from_the_command_line(command, tmp_path):
    files = [BENCH / f"250Nm-{way}.csv" for way in ("forward", "backward")]
    run = command(
        "cycloid-fit",
        "identify",
        *files,
        "--pair",
        BENCH / "pair.toml",
        "-o",
        "fit.json",
        "--surface",
        "s.nc",
        "--plot",
        "fit.png",
        "--report",
        "fit.html",
        "--bootstrap",
        "50",
    )
    assert run.returncode == 0, run.stderr
    assert run.stdout.startswith("Explained")
    assert "centre_distance_x" in run.stdout
    assert "Measured and fitted" in (tmp_path / "fit.html").read_text()
    fit = json.loads((tmp_path / "fit.json").read_text())
    assert fit["parameters"]["eccentricity"]["value"] == pytest.approx(1.5e-6, abs=2e-7)
    assert len(fit["data"]) == 2
    assert (tmp_path / "fit.png").stat().st_size > 20000
    again = command("cycloid-fmu", "build", BENCH / "pair.toml", "--surface", "s.nc", "-o", "d.fmu")
    assert again.returncode == 0, again.stderr


def test_curve_from_the_command_line(command, tmp_path):
    run = command(
        "cycloid-fit",
        "curve",
        BENCH / "30Nm-forward.csv",
        "--pair",
        BENCH / "pair.toml",
        "-o",
        "c.nc",
        "--plot",
        "c.pdf",
        "--json",
    )
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


FILES = [BENCH / f"{load}-forward.csv" for load in ("30Nm", "100Nm", "250Nm")]


@pytest.mark.parametrize("verb", ["metrics", "report"])
def test_an_interrupt_keeps_the_figures_of_the_files_that_were_taken(command, tmp_path, monkeypatch, verb):
    def interrupted(stream, *rest):
        def progress(samples):
            if stream.source == str(FILES[2]):
                signal.raise_signal(signal.SIGINT)

        return survey(stream, *rest[:2], progress)

    monkeypatch.setattr("fitting.figures.metrics.survey", interrupted)
    output = "figures.json" if verb == "metrics" else "report.html"
    run = command("cycloid-fit", verb, *FILES, "--ratio", "-39", "-o", output, "--json")
    assert run.returncode == 130, run.stderr
    found = json.loads(run.stdout)
    assert len(found["angular_transmission_error"]["runs"]) == len(found["data"]) == 2
    assert found["notes"][0] == "Interrupted: 2 of 3 recordings were evaluated."
    assert run.stderr.split() == found["notes"][0].split()
    text = (tmp_path / output).read_text(encoding="utf-8")
    assert text.rstrip() == run.stdout.rstrip() if verb == "metrics" else "2 of 3 recordings were evaluated" in text


def test_a_file_that_can_t_be_read_costs_its_own_figures_alone(command, tmp_path):
    (tmp_path / "cut.tdms").write_bytes(b"TDSm\x0e\0")
    run = command("cycloid-fit", "metrics", "cut.tdms", FILES[0], "none.csv", "--ratio", "-39", "-o", "f.json")
    assert run.returncode == 2
    assert "angular_transmission_error" in run.stdout
    assert "cut.tdms: " in run.stderr
    assert "none.csv: No such file" in run.stderr
    assert list(json.loads((tmp_path / "f.json").read_text())["data"]) == [str(FILES[0])]
    run = command("cycloid-fit", "metrics", "cut.tdms", "none.csv", "--ratio", "-39", "-o", "g.json")
    assert run.returncode == 2
    assert len(run.stderr.strip().splitlines()) == 2
    assert not (tmp_path / "g.json").exists()
