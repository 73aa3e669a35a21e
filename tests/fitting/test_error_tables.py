"""Tables of output angle and transmission error, as rigs publish them, from `inspect` to the errors of the drive."""

import dataclasses
import json

import numpy as np
import pytest
from common import ARCSEC

import cycloid_fmu as cy
import fitting
from cycloid_fmu import edge
from fitting.readers.mapping import ChannelMapping, FileMapping, constants_of, read_mapping
from fitting.readers.proposal import name_patterns

SMALL = cy.Pair(gear_teeth=9, pin_circle_radius=0.04, pin_radius=0.004, eccentricity=0.002, face_width=0.01)
POINTS = 250
SHEETS = {  # header with {} for the way, factor from radians, delimiter, decimal
    "brackets": ("Position {} [deg]", "TE {} [arcsec]", 1.0 / ARCSEC, ",", "."),
    "german": ("Abtrieb_{} [°]", "Drehfehler_{} [″]", 1.0 / ARCSEC, ";", ","),
    "signs": ("Output angle {} (deg)", "TE {} (')", 10800.0 / np.pi, "\t", "."),
    "degrees": ("pos {} / deg", "transmission error {} / deg", 180.0 / np.pi, ";", "."),
    "in the middle": ("Pos (deg) {}", "TE (arcsec) {}", 1.0 / ARCSEC, ";", "."),
    "words": ("Winkel {} [°]", "TE {} [Bogensekunden]", 1.0 / ARCSEC, ";", ","),
    "in names": ("pos_{}_deg", "TE_{}_mrad", 1e3, ",", "."),
}


def made(load, *, shared=False, seed=0):
    """Output angle and transmission error of a drive with 3 µm of eccentricity, forward and backward, rad."""
    drive = cy.Drive(SMALL).replace(errors={"eccentricity": "3 um"})
    noise = np.random.default_rng([seed, abs(int(load))])
    found = {}
    for way, sign in (("forward", 1.0), ("backward", -1.0)):
        crank = -sign * np.linspace(0.0, 2.0 * np.pi * 9, POINTS)  # the output of a held ring turns against the crank
        if shared and sign < 0.0:
            crank = crank[::-1]
        error = drive.analyze(sign * load, crank_angle=crank).transmission_error.values[0]
        error = error + noise.normal(0.0, 1e-6, POINTS)
        found[way] = crank / -9 + error, error
    return found


def write(path, sheet, found, *, shared=False):
    angle, error, factor, delimiter, decimal = SHEETS[sheet]
    names, columns = [], []
    for way, (output, te) in found.items():
        if not (shared and columns):
            names.append(angle.format("" if shared else way))
            columns.append(np.degrees(output))
        names.append(error.format(way))
        columns.append(te * factor)
    rows = [delimiter.join(f"{v:.9f}".replace(".", decimal) for v in row) for row in zip(*columns, strict=True)]
    path.write_text("\n".join([delimiter.join(names), *rows]) + "\n", encoding="utf-8")


@pytest.mark.parametrize("sheet", SHEETS)
def test_a_proposed_mapping_gives_both_runs_as_they_were(tmp_path, sheet):
    write(path := tmp_path / "RV_20Nm_10rpm_25C.csv", sheet, found := made(20.0))
    fitting.inspect(path).write(tmp_path / "map.toml")
    runs = fitting.read_recordings(path, tmp_path / "map.toml")
    assert [r.run for r in runs] == ["forward", "backward"]
    for run, (output, error) in zip(runs, found.values(), strict=True):
        recording = run.open(-9.0).read()
        assert recording.output_angle == pytest.approx(output, abs=1e-10)
        assert recording.output_angle - recording.input_angle / -9 == pytest.approx(error, abs=1e-10)
        assert recording.torque == pytest.approx(20.0)
        assert recording.temperature == pytest.approx(298.15)
        assert recording.speed == pytest.approx(10 * 2 * np.pi / 60)
        assert recording.source.endswith(f"25C.csv, {run.run}")


def test_rows_against_the_motion_are_turned_round(tmp_path):
    write(path := tmp_path / "RV_20Nm.csv", "brackets", found := made(20.0, shared=True), shared=True)
    proposed = fitting.inspect(path)
    assert [run.last_row_first for run in proposed.runs] == [False, True]
    proposed.write(tmp_path / "map.toml")
    forward, backward = fitting.curves(fitting.read_recordings(path, tmp_path / "map.toml"), -9.0)
    assert (forward.direction, backward.direction) == (-1, 1)
    back = fitting.read_recordings(path, tmp_path / "map.toml")[1].open(-9.0).read()
    assert back.output_angle == pytest.approx(found["forward"][0][::-1], abs=1e-10)


def test_commands_take_a_proposed_mapping_as_it_stands(command, tmp_path):
    (tmp_path / "pair.toml").write_text(
        'format = "cycloid-pair/1"\n[pair]\ngear_teeth = 9\npins = 10\npin_circle_radius = "40 mm"\n'
        'pin_radius = "4 mm"\neccentricity = "2 mm"\nface_width = "10 mm"\n'
    )
    for load in (20.0, 100.0):
        write(tmp_path / f"rig_{load:g}Nm_10rpm_25C.csv", "brackets", made(load))
    names = [f"rig_{load}Nm_10rpm_25C.csv" for load in (20, 100)]
    run = command("cycloid-fit", "inspect", names[0], "-o", "map.toml")
    assert run.returncode == 0, run.stderr
    assert "transmission_error, backward" in run.stdout
    # Not in the header: the load turns with the motion.
    text = (tmp_path / "map.toml").read_text()
    turned = '[runs.torque]\nfile_name = "_{}Nm"\nunit = "N*m"\ndirection = -1\n'
    as_proposed = command("cycloid-fit", "curve", *names, "--pair", "pair.toml", "--mapping", "map.toml", "--json")
    assert as_proposed.returncode == 0, as_proposed.stderr
    assert json.loads(as_proposed.stdout)["torque"] == pytest.approx([20, 20, 100, 100])
    figures = command("cycloid-fit", "metrics", *names, "--pair", "pair.toml", "--mapping", "map.toml", "--json")
    assert figures.returncode == 0, figures.stderr
    assert len(json.loads(figures.stdout)["angular_transmission_error"]["runs"]) == 4
    (tmp_path / "map.toml").write_text(text + turned)
    fit = command("cycloid-fit", "identify", *names, "--pair", "pair.toml", "--mapping", "map.toml", "--json")
    assert fit.returncode == 0, fit.stderr
    found = json.loads(fit.stdout)["parameters"]["eccentricity"]
    assert found["interval"][0] < 3e-6 < found["interval"][1]
    assert found["value"] == pytest.approx(3e-6, abs=0.5e-6)


@pytest.mark.parametrize(
    ("name", "stated"),
    [
        ("RV160N_500Nm_10rpm_25C", (500.0, 10.0, 25.0)),
        ("T=500_n=10_temp=30", (500.0, 10.0, 30.0)),
        ("RV160N_-500Nm_10rpm_-5C", (-500.0, 10.0, -5.0)),
        ("RV160N_−0,5kNm_7,5rpm_25°C", (-500.0, 7.5, 25.0)),
        ("RV160N-500Nm-10rpm-25C", (500.0, 10.0, 25.0)),
        ("0.5kNm 10 rpm 25 degC", (500.0, 10.0, 25.0)),
        ("n=10 T=-200.5 temp=30", (-200.5, 10.0, 30.0)),
    ],
)
def test_conditions_in_names_of_files(name, stated):
    patterns = name_patterns(f"{name}.csv")
    assert all(pattern for pattern, _, _ in patterns.values())
    mapping = FileMapping(**{r: ChannelMapping(file_name=p, unit=u) for r, (p, u, _) in patterns.items()})
    found = constants_of(f"{name}.csv", mapping)
    wanted = (stated[0], stated[1] * 2 * np.pi / 60, stated[2] + 273.15)
    assert [found["torque"], found["speed"], found["temperature"]] == pytest.approx(list(wanted))


@pytest.mark.parametrize(
    ("name", "asked"), [("RV-500Nm", "minus"), ("T=30", "torque or temperature"), ("a_20Nm_of_50Nm", "which")]
)
def test_a_name_that_can_be_read_in_two_ways_is_asked(tmp_path, name, asked):
    write(path := tmp_path / f"{name}.csv", "brackets", made(20.0))
    proposed = fitting.inspect(path)
    assert asked in proposed.text
    proposed.write(tmp_path / "map.toml")
    with pytest.raises(edge.InputError, match=r"\[torque\] file_name"):
        read_mapping(tmp_path / "map.toml")


def test_a_column_without_a_unit_is_asked(tmp_path):
    (path := tmp_path / "a_20Nm.csv").write_text("Position [deg],TE\n0,0.1\n40,0.2\n80,0.1\n120,0.2\n")
    fitting.inspect(path).write(tmp_path / "map.toml")
    (recording,) = fitting.read_recordings(path, tmp_path / "map.toml")
    with pytest.raises(edge.InputError, match='"TE" for transmission_error has no unit'):
        recording.open(-9.0)


def test_a_transmission_error_needs_the_ratio(tmp_path):
    write(path := tmp_path / "a_20Nm.csv", "brackets", made(20.0))
    fitting.inspect(path).write(tmp_path / "map.toml")
    with pytest.raises(edge.InputError, match="ratio"):
        fitting.metrics(fitting.read_recordings(path, tmp_path / "map.toml"))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('output_angle = {column = "a", file_name = "{}deg"}', "needs column"),
        ('torque = {file_name = "Nm", unit = "N*m"}', "Nm"),
        ('torque = {file_name = "{}Nm"}', "unit"),
        ('input_angle = {column = "b"}', "one of the two"),
        ("last_row_first = true\ntime = {column = 't'}", r"the \[time\] column determines the first sample"),
        ("[[runs]]\nname = 'a'\n[[runs]]\nname = 'a'", "needs its own name"),
    ],
)
def test_mappings_that_contradict_themselves_are_refused(tmp_path, text, said):
    base = {"output_angle": "{column = 'a'}", "transmission_error": "{column = 'e'}", "torque": "{column = 'm'}"}
    head = [f"{n} = {v}" for n, v in base.items() if not text.startswith(n)]
    (tmp_path / "m.toml").write_text("\n".join(['format = "cycloid-mapping/1"', *head, text]))
    with pytest.raises(edge.InputError, match=said):
        read_mapping(tmp_path / "m.toml")


def test_columns_hold_conditions_too(tmp_path):
    output, error = made(20.0)["forward"]
    rows = [f"{a},{e / ARCSEC},20,15,30" for a, e in zip(np.degrees(output), error, strict=True)]
    head = "Position [deg],TE [arcsec],Load [Nm],Speed [rpm],Oil [°C]"
    (path := tmp_path / "run.csv").write_text("\n".join([head, *rows]), encoding="utf-8")
    fitting.inspect(path).write(tmp_path / "map.toml")
    (curve,) = fitting.curves(fitting.read_recordings(path, tmp_path / "map.toml"), -9.0)
    assert curve.torque == pytest.approx(20.0)
    assert curve.temperature == pytest.approx(303.15)
    assert curve.running_speed == pytest.approx(15 * 2 * np.pi / 60)


def test_columns_of_one_name_go_together_in_their_order(tmp_path):
    (output, error), (other, beside) = made(20.0).values()
    columns = (np.degrees(output), error / ARCSEC, np.degrees(other), beside / ARCSEC)
    rows = [";".join(f"{v:.9f}" for v in row) for row in zip(*columns, strict=True)]
    (path := tmp_path / "a_20Nm.csv").write_text("\n".join(["Pos [deg];TE [″];Pos [deg];TE [″]", *rows]), "utf-8")
    fitting.inspect(path).write(tmp_path / "map.toml")
    first, second = fitting.read_recordings(path, tmp_path / "map.toml")
    assert second.open(-9.0).read().output_angle == pytest.approx(other, abs=1e-10)
    assert first.open(-9.0).read().source.endswith(", run 1")


def test_a_report_of_many_dense_curves_stays_light(tmp_path):
    turn = np.linspace(0.0, 2.0 * np.pi, 6000, endpoint=False)
    noise = np.random.default_rng(0)
    runs = [
        fitting.Run(input_angle=-39 * turn, output_angle=turn + noise.normal(0.0, 1e-6, 6000), torque=t, name=f"{t}")
        for t in range(1, 7)
    ]
    found = fitting.metrics(runs, ratio=-39.0)
    many = dataclasses.replace(found, surveyed=found.surveyed * 16, spectra=found.spectra * 16)
    fitting.report(many, tmp_path / "many.html")
    assert (tmp_path / "many.html").stat().st_size < 10e6


def test_an_unknown_unit_is_asked_and_no_run_is_dropped(tmp_path):
    rows = [f"{a},{e},{e}" for a, e in zip(range(0, 360, 5), np.cos(np.arange(72)), strict=True)]
    head = "Position [deg],TE forward [arcsex],TE backward [arcsec]"
    (path := tmp_path / "a_20Nm.csv").write_text("\n".join([head, *rows]))
    fitting.inspect(path).write(tmp_path / "map.toml")
    forward, backward = fitting.read_recordings(path, tmp_path / "map.toml")
    assert backward.open(-9.0).read().time.size == 72
    with pytest.raises(edge.InputError, match=r"TE forward.*arcsex"):
        forward.open(-9.0)
