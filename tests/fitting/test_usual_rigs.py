"""Files as usual rigs write them go from `inspect` to figures as they are; the drive in them is a simulated one."""

import gzip
import json
import re
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest
from common import EXAMPLES, MEASURED
from hypothesis import given
from hypothesis import strategies as st

import fitting
from cycloid_fmu import edge
from cycloid_fmu.analysis import solve
from cycloid_fmu.drive import Drive
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.surfaces.structured import structured_value
from cycloid_fmu.surfaces.surface import surface_of_pair
from fitting.readers import formats
from fitting.readers.inspection import inspect
from fitting.readers.mapping import read_mapping
from fitting.readers.recording import RecordingStream

ARCMIN = np.pi / 10800
ARCSEC = ARCMIN / 60
RATIO = -39.0
NOISE = 0.3 * ARCSEC
measured_drives = pytest.mark.skipif(not MEASURED.is_dir(), reason=f"the measured drives are not in {MEASURED}")


def turned(pair, load, *, each=24, backward=False):
    """Crank and output angles of one output turn of a drive at a load, with noise."""
    crank = np.arange(39 * each + 1) * 2 * np.pi / each
    error = solve(DriveValue.as_stated(pair), load, crank, with_play=False).transmission_error[0]
    noise = np.random.default_rng(abs(int(load))).normal(0.0, NOISE, crank.size)
    way = slice(None, None, -1 if backward else 1)
    return crank[way], (crank / RATIO + error + noise)[way]


def looped(rated, stiffness, play, friction, *, loops=2, each=1500):
    """Torque and output angle of loops with play, dry friction and linear stiffness, the input locked."""
    ramp = np.arange(each) / each
    torque, angle = [], []
    for _ in range(loops):
        for sign in (1, -1):
            for loading, share in ((True, ramp), (False, 1.0 - ramp)):
                t = sign * rated * np.maximum(share, 1e-12)
                torque.append(t)
                angle.append(sign * play / 2 + (t + sign * friction * (-1 if loading else 1)) / stiffness)
    return np.concatenate(torque), np.concatenate(angle)


def comma(value, digits=9):
    return f"{value:.{digits}f}".replace(".", ",")


def semicolons(path, crank, output, torque):
    """A controller's log in German: Windows-1252, decimal commas, a state as text, cells of an overloaded sensor."""
    lines = ["Prüfstand 3;;;;", "Zeit [ms];Status;Motor [°];Abtrieb [°];Moment [Nm]"]
    for i, (a, b, load) in enumerate(zip(np.degrees(crank), np.degrees(output), torque, strict=True)):
        moment = "OVL" if i in (0, 100) else comma(load, 3)
        lines.append(f"{comma(i, 1)};{'Läuft' if i % 7 else 'OK'};{comma(a)};{comma(b)};{moment}")
    path.write_bytes(("\r\n".join(lines) + "\r\n").encode("cp1252"))
    return path


def stamped(path, crank, output, torque, *, period=0.004):
    """A data logger's table: ISO 8601 stamps with a zone, setpoints beside the measured values."""
    begun = datetime(2024, 3, 1, 12, 0, 0, tzinfo=UTC)
    lines = ["timestamp,torque_setpoint [Nm],torque [Nm],motor_setpoint [rev],motor [rev],flange [deg],comment"]
    for i, (a, b, load) in enumerate(zip(crank / (2 * np.pi), np.degrees(output), torque, strict=True)):
        stamp = (begun + timedelta(seconds=i * period)).isoformat(timespec="milliseconds")
        lines.append(f"{stamp},200,{load:.3f},{round(a, 1)},{a:.9f},{b:.9f},{'start of run' if i == 0 else ''}")
    path.write_text("\n".join(lines) + "\n")
    return path


def ticked(path, torque, angle, *, each=6, tick=0.0156):
    """A motor controller's log, compressed: a clock in ticks with several samples each, a commanded torque."""
    rows = [
        f"{i // each * tick:.4f},{a / (2 * np.pi):.10f},{t:.4f},{t:.1f},0"
        for i, (t, a) in enumerate(zip(torque, angle, strict=True))
    ]
    header = "TIME [s],POSITION [rev],TORQUE [Nm],CONTROL_TORQUE [Nm],FAULT"
    path.write_bytes(gzip.compress("\n".join([header, *rows, ""]).encode()))
    return path


@pytest.mark.slow(12)
def test_semicolons_and_a_status_column_go_to_identified_errors(command, tmp_path, made):
    """Four runs of the drive as made: what is identified is what it was made with."""
    names = []
    for number, load in enumerate((20.0, -20.0, 200.0, -200.0)):
        crank, output = turned(made, load, each=12, backward=load < 0.0)
        path = semicolons(tmp_path / f"lauf {number}.csv", crank, output, np.full(crank.size, load))
        names.append(path.name)
    assert command("cycloid-fit", "inspect", names[0], "-o", "map.toml").returncode == 0
    mapping = read_mapping(tmp_path / "map.toml")
    assert (mapping.ratio, mapping.time.column, mapping.torque.column) == (RATIO, "Zeit", "Moment")
    pair = EXAMPLES / "drive-39-40.toml"
    run = command("cycloid-fit", "identify", *names, "--mapping", "map.toml", "--pair", pair, "-o", "fit.json")
    assert run.returncode == 0, run.stderr
    assert 'Moment is "OVL", no value; the column has 2 such cells' in run.stderr
    surface, within = surface_of_pair(made), []
    for name, one in json.loads((tmp_path / "fit.json").read_text())["parameters"].items():
        if not one["held"] and one["data_share"] > 0.5:
            low, high = one["interval"]
            within.append(low <= structured_value(surface, name) <= high)
    assert len(within) > 10
    assert np.mean(within) > 0.8


def test_iso_stamps_go_to_the_transmission_error_and_its_curve(command, tmp_path, made):
    """The ratio is found in the data; speed, range and curve are those of the simulated drive."""
    crank, output = turned(made, 200.0, each=48)
    stamped(tmp_path / "run.csv", crank, output, np.full(crank.size, 200.0))
    assert command("cycloid-fit", "inspect", "run.csv", "-o", "map.toml").returncode == 0
    mapping = read_mapping(tmp_path / "map.toml")
    assert mapping.ratio == RATIO
    assert (mapping.time.column, mapping.input_angle.column, mapping.torque.column) == ("timestamp", "motor", "torque")
    run = command("cycloid-fit", "metrics", "run.csv", "--mapping", "map.toml", "--json")
    assert run.returncode == 0, run.stderr
    figure = json.loads(run.stdout)["angular_transmission_error"]
    truth = np.ptp(output - crank / RATIO)
    assert figure["value"] == pytest.approx(truth, abs=6 * NOISE)
    run = command("cycloid-fit", "curve", "run.csv", "--mapping", "map.toml", "--json")
    assert run.returncode == 0, run.stderr
    curve = json.loads(run.stdout)
    error = solve(DriveValue.as_stated(made), 200.0, curve["input_angle"][0], with_play=False).transmission_error[0]
    left = np.array(curve["transmission_error"][0]) - error
    assert np.std(left) == pytest.approx(NOISE, rel=0.1)
    (one,) = fitting.curves(fitting.read_recordings(tmp_path / "run.csv", tmp_path / "map.toml"))
    assert one.running_speed == pytest.approx(2 * np.pi / 48 / 0.004 / 39, rel=1e-6)


def test_a_clock_in_ticks_goes_to_the_figures_of_the_loop(command, tmp_path):
    """Torque with noise, six samples for each tick: the figures are those of play, friction and stiffness."""
    rated, stiffness, play, friction = 20.0, 300.0, np.radians(1.0), 1.5
    torque, angle = looped(rated, stiffness, play, friction, loops=4)
    torque += np.random.default_rng(1).normal(0.0, 0.05, torque.size)
    ticked(tmp_path / "loop.csv.gz", torque, angle)
    assert command("cycloid-fit", "inspect", "loop.csv.gz", "-o", "map.toml").returncode == 0
    mapping = read_mapping(tmp_path / "map.toml")
    assert (mapping.time.column, mapping.output_angle.unit, mapping.torque.column) == ("TIME", "rev", "TORQUE")
    assert mapping.input_angle is None
    words = ("cycloid-fit", "metrics", "loop.csv.gz", "--mapping", "map.toml", "--rated-torque", "20 N*m", "--json")
    run = command(*words)
    assert run.returncode == 0, run.stderr
    found = json.loads(run.stdout)
    assert any(f"{torque.size} samples share their time stamp" in note for note in found["notes"])
    assert found["hysteresis_loss"]["loops"] == 4
    truth = {
        "hysteresis_loss": play + 2 * friction / stiffness,
        "backlash": play,
        "torsional_stiffness": stiffness,
    }
    for name, value in truth.items():
        assert found[name]["value"] == pytest.approx(value, rel=0.01), name


@pytest.mark.slow(1)
def test_rigs_with_other_headers_share_a_report(command, tmp_path, made):
    """Each file takes the mapping whose columns it has; one with our names needs none; both is a sentence."""
    crank, output = turned(made, 200.0)
    load = np.full(crank.size, 200.0)
    stamped(tmp_path / "stamped.csv", crank, output, load)
    semicolons(tmp_path / "semicolons.csv", crank, output, load)
    torque, angle = looped(181.0, 1e5, 1e-4, 2.0)
    ticked(tmp_path / "loop.csv.gz", torque, angle)
    own = "time [s],input_angle [rad],output_angle [rad],torque [N*m]"
    rows = [f"{i * 1e-3:.3f},{a:.9f},{b:.9f},200" for i, (a, b) in enumerate(zip(crank, output, strict=True))]
    (tmp_path / "own.csv").write_text("\n".join([own, *rows, ""]))
    files = ("stamped.csv", "semicolons.csv", "loop.csv.gz")
    mappings = [f"{number}.toml" for number in range(3)]
    for file, mapping in zip(files, mappings, strict=True):
        inspect(tmp_path / file).write(tmp_path / mapping)
    given = [word for name in mappings for word in ("--mapping", name)]
    run = command("cycloid-fit", "metrics", *files, "own.csv", *given, "--ratio", RATIO, "--json")
    assert run.returncode == 0, run.stderr
    found = json.loads(run.stdout)
    assert set(found["data"]) == {*files, "own.csv"}
    assert len(found["angular_transmission_error"]["runs"]) == 3
    (tmp_path / "again.toml").write_text((tmp_path / "2.toml").read_text())
    run = command("cycloid-fit", "metrics", "loop.csv.gz", "--mapping", "2.toml", "--mapping", "again.toml")
    assert run.returncode == 2
    said = "loop.csv.gz: several mappings suit its columns, 2.toml, again.toml; give only one of them"
    assert run.stderr.strip() == f"{said} with this file."
    run = command("cycloid-fit", "metrics", "loop.csv.gz", "--mapping", "0.toml", "--mapping", "1.toml")
    assert run.returncode == 2
    assert "no mapping suits its columns: 0.toml needs " in run.stderr
    run = command("cycloid-fit", "metrics", "loop.csv.gz", "--mapping", "0.toml")
    assert run.returncode == 2
    assert 'there is no column "motor"' in run.stderr


MAP = 'format = "cycloid-mapping/1"\n'


def written(tmp_path, name, text):
    (tmp_path / name).write_text(text, encoding="utf-8")
    return tmp_path / name


def table(tmp_path, columns, name="run.csv"):
    rows = [",".join(f"{v:.10g}" for v in row) for row in zip(*columns.values(), strict=True)]
    return written(tmp_path, name, "\n".join([",".join(columns), *rows, ""]))


def quoted_in_german(path, torque, output, crank=None):
    """A rig's export: UTF-8 with a mark, quoted text, a row of units, a trailing semicolon, a constant temperature."""
    names, units = ["Status", "Zeit", "Drehmoment Abtrieb", "Winkel Abtrieb"], ["", "[ms]", "[Nm]", "[°]"]
    columns = [torque, np.degrees(output)]
    if crank is not None:
        names, units, columns = [*names, "Winkel Antrieb"], [*units, "[°]"], [*columns, np.degrees(crank)]
    rows = [[*names, "Öltemperatur", "Zähler"], [*units, "[°C]", "[-]"]]
    lines = ['"Prüfprotokoll";"Getriebe 17"', ""] + [";".join(f'"{cell}"' for cell in row) + ";" for row in rows]
    for i, values in enumerate(zip(*columns, strict=True)):
        state = "gültig" if i % 97 else "Messbereich überschritten"
        cells = [f'"{state}"', comma(2.0 * i, 1), *map(comma, values), "23,5", str(i % 7)]
        lines.append(";".join(cells) + ";")
    path.write_bytes(b"\xef\xbb\xbf" + ("\r\n".join(lines) + "\r\n").encode())


def stamped_in_french(path, torque, output, crank=None):
    """Tabs, Windows-1252, ISO 8601 stamps with a decimal comma and a zone, the command before the measured torque."""
    begun = datetime(2024, 3, 31, 1, 59, 58)
    names = ["Horodatage", "État", "Consigne couple [N·m]", "Couple mesuré [N·m]", "Angle sortie [°]"]
    lines = ["\t".join(names + ([] if crank is None else ["Angle entrée [tr]"]) + ["Température [°C]"])]
    for i, (load, angle) in enumerate(zip(torque, np.degrees(output), strict=True)):
        stamp = (begun + timedelta(seconds=0.005 * i)).isoformat(timespec="milliseconds").replace(".", ",") + "+01:00"
        cells = [stamp, "prêt" if i < 3 else "mesure", comma(round(load, -1), 0), comma(load), comma(angle)]
        cells += [] if crank is None else [comma(crank[i] / (2 * np.pi))]
        lines.append("\t".join([*cells, "---" if i % 50 == 7 else "21,00"]))
    path.write_bytes(("\n".join(lines) + "\n").encode("cp1252"))


def counted_ticks(path, torque, output, crank=None):
    """UTF-16, bars, whole ticks of 1/64 s with eight samples each, counts of the motor that roll over, a command."""
    counts = "" if crank is None else "MOTOR_CNT|"
    lines = ["# logger v2.1", f"TICK_TIME|MODE|{counts}OUT_ANGLE [rad]|TORQUE [Nm]|TORQUE_CMD [Nm]"]
    for i, (load, angle) in enumerate(zip(torque, output, strict=True)):
        count = "" if crank is None else f"{int(np.floor(crank[i] / (2 * np.pi) * 65536)) % 65536}|"
        lines.append(f'{i // 8}|"RUN"|{count}{angle:.10f}|{load:.4f}|{load:.0f}')
    path.write_bytes(("\r\n".join(lines) + "\r\n").encode("utf-16"))


RIGS = {"German": (quoted_in_german, 24), "French": (stamped_in_french, 24), "ticks": (counted_ticks, 48)}


@pytest.mark.slow(2)
@pytest.mark.parametrize("rig", RIGS)
def test_a_rig_s_loop_and_run_go_from_inspect_to_a_report(command, tmp_path, made, rig):
    """The figures are those of the simulated drive and joint; the loop's mapping suits the run too, with less of it."""
    write, each = RIGS[rig]
    crank, output = turned(made, 160.0, each=each)
    torque, angle = looped(160.0, 6e4, 1.2 * ARCMIN, 6.0)
    write(tmp_path / "run.csv", np.full(crank.size, 160.0), output, crank)
    write(tmp_path / "loop.csv", torque, angle)
    for name in ("run", "loop"):
        assert command("cycloid-fit", "inspect", f"{name}.csv", "-o", f"{name}.toml").returncode == 0
        if rig == "ticks":  # no file says how long they are
            text = (tmp_path / f"{name}.toml").read_text(encoding="utf-8")
            written(tmp_path, f"{name}.toml", re.sub('unit = "" .*ticks per second', "rate = 64", text))
    mapping = read_mapping(tmp_path / "run.toml")
    assert mapping.ratio == RATIO
    assert mapping.torque.column == {"German": "Drehmoment Abtrieb", "French": "Couple mesuré", "ticks": "TORQUE"}[rig]
    words = ("run.csv", "loop.csv", "--mapping", "loop.toml", "--mapping", "run.toml", "--rated-torque", "160 N*m")
    run = command("cycloid-fit", "report", *words, "-o", "report.html")
    assert run.returncode == 0, run.stderr
    run = command("cycloid-fit", "metrics", *words, "--json")
    assert run.returncode == 0, run.stderr
    figures = json.loads(run.stdout)
    truth = {
        "angular_transmission_error": np.ptp(output - crank / RATIO),
        "backlash": 1.2 * ARCMIN,
        "hysteresis_loss": 1.2 * ARCMIN + 12.0 / 6e4,
        "torsional_stiffness": 6e4,
    }
    for name, value in truth.items():
        assert figures[name]["value"] == pytest.approx(value, rel=0.03), name
    samples_per_second = {"German": 500.0, "French": 200.0, "ticks": 512.0}[rig]
    (curve,) = fitting.curves(fitting.read_recordings(tmp_path / "run.csv", tmp_path / "run.toml"))
    assert curve.running_speed == pytest.approx(samples_per_second / each * 2 * np.pi / 39, rel=2e-3)
    run = command("cycloid-fit", "maps", "run.csv", "--mapping", "run.toml", "--json")
    assert run.returncode == 0, run.stderr


def test_maps_are_those_of_one_drive(tmp_path):
    """Without a pair or ratio the recordings state it; two ratios are refused."""
    for teeth in (39, 29):
        crank = np.linspace(0.0, 2 * np.pi * teeth, 3000)
        path = table(tmp_path, {"motor [rad]": crank, "flange [rad]": -crank / teeth}, f"{teeth}.csv")
        inspect(path).write(path.with_suffix(".toml"))
    recordings = {
        teeth: fitting.read_recordings(tmp_path / f"{teeth}.csv", tmp_path / f"{teeth}.toml") for teeth in (39, 29)
    }
    assert fitting.maps(recordings[29]).attrs["ratio"] == -29
    with pytest.raises(
        edge.InputError, match=r"the recordings state several ratios, -39 \(.*39.csv\), -29 \(.*29.csv\); "
    ):
        fitting.maps([*recordings[39], *recordings[29]])


def test_of_two_nameless_angles_the_input_turns_further_whatever_their_units(tmp_path):
    turns = np.linspace(0.0, 39.0, 500)
    found = inspect(table(tmp_path, {"B [deg]": turns / 39 * 360.0, "A [rev]": turns}))
    assert {role: one.channel.name for role, one in found.roles.items()} == {"input_angle": "A", "output_angle": "B"}
    assert found.ratio == 39.0


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('time = {column = "t", rate = 64, unit = "s"}', r"\[time\] rate and unit: give one of the two"),
        ('time = {unit = "s"}', r"\[time\] needs a column, or a rate"),
        ('time = {column = "t", rate = inf}', r"\[time\] rate = inf: it must be"),
    ],
)
def test_a_clock_has_a_unit_or_a_rate(tmp_path, text, said):
    with pytest.raises(edge.InputError, match=said):
        read_mapping(written(tmp_path, "map.toml", f'{MAP}output_angle = {{column = "a"}}\n{text}\n'))


@pytest.mark.parametrize("pulley", [-3.346, 2.5])
def test_an_encoder_behind_a_pulley_is_referred_to_the_output(tmp_path, pulley):
    """Counts that are not whole per turn, which roll over at the encoder's own turn."""
    crank = np.linspace(0.0, 4 * np.pi * 39, 6000)
    output = crank / RATIO + 20 * ARCSEC * np.cos(crank)
    counts = np.mod(output * pulley / (2 * np.pi) * 1204.6, 1204.6)
    path = table(tmp_path, {"motor [rad]": crank, "belt": counts})
    text = f'{MAP}ratio = -39\npulley = {{ratio = {pulley}}}\ntorque = {{value = "-50 N*m"}}\n'
    text += 'input_angle = {column = "motor"}\noutput_angle = {column = "belt", counts_per_turn = 1204.6}\n'
    found = RecordingStream(path, read_mapping(written(tmp_path, "map.toml", text))).read()
    assert found.output_angle - found.output_angle[0] == pytest.approx(output - output[0], abs=1e-7)
    assert (found.torque == -50.0).all()
    assert found.limits.output_resolution == pytest.approx(2 * np.pi / 1204.6 / abs(pulley))
    assert any(f"at multiples of order {abs(pulley):g} of the output" in note for note in found.notes)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('output_angle = {column = "a"}\npulley = {ratio = 0.0}\n', r"\[pulley\] ratio = 0.0: give the signed ratio"),
        (
            'output_angle = {column = "a", counts_per_turn = 0.5}\n',
            "counts_per_turn = 0.5: give a number of at",
        ),
        ('output_angle = {column = "a"}\ntorque = {value = "5"}\n', r'\[torque\] value = "5": write one number'),
        ('output_angle = {column = "a"}\ntorque = {value = "5 mm"}\n', "measures something else"),
        ('output_angle = {column = "a"}\ntorque = {value = "5 N*m", unit = "N*m"}\n', "has its own unit"),
        ('output_angle = {column = "a"}\ntorque = {value = "5 N*m", column = "b"}\n', "needs one of column, file_name"),
        ('output_angle = {value = "5 deg"}\n', "only torque, speed, temperature can be constant"),
    ],
)
def test_a_wrong_value_in_a_mapping_is_one_sentence(tmp_path, text, said):
    with pytest.raises(edge.InputError, match=said) as refused:
        read_mapping(written(tmp_path, "map.toml", MAP + text))
    assert "\n" not in str(refused.value)
    assert str(refused.value).startswith(str(tmp_path / "map.toml"))


def test_without_a_torque_the_load_is_unknown_and_no_model_is_fitted(tmp_path, nominal):
    crank = np.linspace(0.0, 2 * np.pi * 39, 4000)
    path = table(tmp_path, {"motor [rad]": crank, "flange [rad]": crank / RATIO + 20 * ARCSEC * np.cos(crank)})
    inspect(path).write(tmp_path / "map.toml")
    recordings = fitting.read_recordings(path, tmp_path / "map.toml")
    found = fitting.metrics(recordings)
    (curve,) = found.curves
    assert found.figures["angular_transmission_error"].value == pytest.approx(40 * ARCSEC, rel=1e-3)
    assert np.isnan(curve.torque)
    assert [*found.figures["angular_transmission_error"].runs] == [f"{path}, unknown load, forward"]
    assert f"{path}: no torque is mapped; the load is unknown." in found.notes
    page = tmp_path / "report.html"
    fitting.report(found, page)
    assert "nan N" not in page.read_text(encoding="utf-8")
    with pytest.raises(edge.InputError, match="the torque is unknown; a model needs the load"):
        fitting.identify(recordings, Drive(nominal))


def test_a_loop_without_times_has_its_figures_and_no_seconds(tmp_path):
    """The same loop with and without its times: equal figures, but only one has seconds."""
    torque, angle = looped(20.0, 300.0, 0.01, 0.5)
    columns = {"t [s]": np.arange(torque.size) * 0.1, "angle [rad]": angle, "M [Nm]": torque}
    timed = table(tmp_path, columns, "timed.csv")
    columns.pop("t [s]")
    untimed = table(tmp_path, columns, "untimed.csv")
    found = {}
    for path in (timed, untimed):
        mapping = path.with_suffix(".toml")
        inspect(path).write(mapping)
        found[path] = fitting.metrics(fitting.read_recordings(path, mapping), rated_torque=20.0)
    for name, figure in found[timed].figures.items():
        assert found[untimed].figures[name].value == pytest.approx(figure.value, rel=1e-9), name
    (one,) = found[untimed].surveyed
    assert np.isnan(one.duration)
    fitting.report(found[untimed], page := tmp_path / "untimed.html")
    text = page.read_text(encoding="utf-8")
    assert "Torque over samples" in text
    assert "time [s]" not in text


@pytest.mark.parametrize("speed", [0.1, 300.0])
def test_a_coarse_clock_keeps_the_transmission_error_of_a_turning_crank(tmp_path, speed):
    """Where the crank turns within a tick a mean would smooth its error away: every sample is kept, at even times."""
    time = np.arange(20000) / 2000.0
    crank = speed * time
    error = 20 * ARCSEC * np.cos(40 * crank / 39)
    tick = 0.016
    path = table(
        tmp_path,
        {
            "t [s]": np.arange(time.size) // 32 * tick,
            "motor [rad]": crank,
            "flange [rad]": crank / RATIO + error,
            "M [Nm]": np.full(time.size, 5.0),
        },
    )
    inspect(path).write(tmp_path / "map.toml")
    found = RecordingStream(path, read_mapping(tmp_path / "map.toml")).read()
    assert (np.diff(found.time) > 0.0).all()
    (note,) = [one for one in found.notes if "time stamp" in one]
    assert f"{time.size} samples share their time stamp with others (the clock's usual step is 0.016 s)" in note
    if speed > 1.0:
        assert found.output_angle == pytest.approx(crank / RATIO + error, abs=1e-8)
        assert found.time == pytest.approx(time, abs=1e-4)
        assert "even times" in note
    else:
        assert found.time.size == 625
        assert found.input_angle == pytest.approx(crank.reshape(-1, 32).mean(axis=1), abs=1e-8)
        assert "averaged" in note


@pytest.mark.parametrize("samples", [2, 50])
def test_a_clock_that_stands_still_gives_one_sample(tmp_path, samples):
    columns = {"time [s]": np.zeros(samples), "input_angle [rad]": np.zeros(samples)}
    path = table(tmp_path, {**columns, "output_angle [rad]": np.arange(samples), "torque [N*m]": np.arange(samples)})
    with pytest.raises(edge.InputError, match=f"{samples} samples share their time stamp .* has 1 samples; a curve"):
        RecordingStream(path).read()


@pytest.mark.parametrize("piece", [7, 64, 1000])
def test_ticks_are_the_same_over_the_seams_of_pieces(tmp_path, monkeypatch, piece):
    torque, angle = looped(20.0, 300.0, 0.01, 0.5, each=200)
    path = ticked(tmp_path / "loop.csv.gz", torque, angle)
    inspect(path).write(tmp_path / "map.toml")
    whole = RecordingStream(path, mapping := read_mapping(tmp_path / "map.toml")).read()
    monkeypatch.setattr("fitting.readers.tables.PIECE", piece)
    parts = RecordingStream(path, mapping).read()
    for name in ("time", "output_angle", "torque"):
        assert getattr(parts, name) == pytest.approx(getattr(whole, name), abs=1e-12)
    assert whole.torque == pytest.approx(
        np.add.reduceat(torque, np.arange(0, torque.size, 6))
        / np.diff(np.arange(0, torque.size + 6, 6).clip(max=torque.size)),
        abs=1e-4,
    )


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("t;a;s\n0,5;OVL;OK\n1,5;2,5;OK\n2,5;3;no\n", {"t": [0.5, 1.5, 2.5], "a": [None, 2.5, 3.0]}),
        ("t;a\ns;1\n0,5;2\n1,5;2,5\n", {"t": [0.5, 1.5], "a": [2.0, 2.5]}),
        ("OK;1,5;x\nOK;2,5;y\n", {"column 2": [1.5, 2.5]}),
        ("1.5,OVL\n2.5,3\n3.5,4\n", {"column 1": [1.5, 2.5, 3.5], "column 2": [None, 3.0, 4.0]}),
        ("time\t1\t2\n0.5\t2\t3\n1.5\t3\tNaN\n", {"time": [0.5, 1.5], "1": [2.0, 3.0], "2": [3.0, None]}),
        ("t,a,note\n2024-03-01 12:00:00,1,\n2024-03-01 12:00:01.5,x,y\n", {"t": [0.0, 1.5], "a": [1.0, None]}),
        ("t;a\n2024-03-01T12:00:00,25+01:00;1,5\n2024-03-01T11:00:00,75Z;2,5\n", {"t": [0.0, 0.5], "a": [1.5, 2.5]}),
        ("t;a\n0,5;2;\n1,5;3;\n", {"t": [0.5, 1.5], "a": [2.0, 3.0], "column 3": [None, None]}),
        ("time [UTC];a\n2024-03-01T12:00:00Z;1\n2024-03-01T12:00:01Z;2\n", {"time": [0.0, 1.0], "a": [1.0, 2.0]}),
        ("a,b,c\n1,2,3\n,,\n4,,6\n", {"a": [1.0, None, 4.0], "b": [2.0, None, None], "c": [3.0, None, 6.0]}),
        ('"t","a"\n"0,50","2,125"\n"1,50","3"\n', {"t": [0.5, 1.5], "a": [2.125, 3.0]}),
        ('"S";"t";"a"\n"";"[s]";"[-]"\n"OK";0,5;2\n"OK";1,5;2,5\n', {"t": [0.5, 1.5], "a": [2.0, 2.5]}),
    ],
)
def test_the_columns_of_numbers_decide(tmp_path, text, expected):
    file = formats.open_bench_file(written(tmp_path, "a.csv", text))
    assert [c.name for c in file.channels] == [*expected]
    parts = [*file.pieces([*expected])]
    for name, values in expected.items():
        found = np.concatenate([part.values[name] for part in parts])
        assert [None if np.isnan(one) else float(one) for one in found] == values


def test_quoted_numbers_that_may_be_thousands_are_refused(tmp_path):
    file = formats.open_bench_file(written(tmp_path, "a.csv", 't,a\n0,"1,234"\n1,"2,345"\n'))
    with pytest.raises(edge.InputError, match='line 2: a is "1,234"; it must be a number with a decimal point'):
        [*file.pieces(["t", "a"])]


@given(
    delimiter=st.sampled_from([";", "\t", "|", ","]),
    comma=st.booleans(),
    rows=st.integers(4, 40),
    seed=st.integers(0, 10**6),
    kinds=st.lists(st.sampled_from(["number", "text", "stamp", "sparse"]), min_size=1, max_size=5),
    preamble=st.integers(0, 3),
    first_is_bad=st.booleans(),
)
def test_any_table_of_numbers_stamps_and_text_is_read(
    tmp_path_factory, delimiter, comma, rows, seed, kinds, preamble, first_is_bad
):
    """Cells are replaced by words, also in the first row of data; what is left is what was written."""
    kinds, decimal = ["number", *kinds], "," if comma and delimiter != "," else "."
    rng = np.random.default_rng(seed)
    numbers = {i: rng.normal(0.0, 100.0, rows).round(3) for i, kind in enumerate(kinds) if kind in ("number", "sparse")}
    cells = np.empty((rows, len(kinds)), object)
    for i, kind in enumerate(kinds):
        for row in range(rows):
            if kind == "text":
                cells[row, i] = rng.choice(["OK", "läuft gut", "", "Stufe 3"])
            elif kind == "stamp":
                cells[row, i] = f"2024-02-29 23:59:{row:02}{decimal}250"
            else:
                cells[row, i] = f"{numbers[i][row]:.3f}".replace(".", decimal)
        if kind == "sparse":
            for row in {*rng.integers(0, rows, rows // 5), *([0] if first_is_bad else [])}:
                cells[row, i], numbers[i][row] = rng.choice(["OVL", "", "NaN"]), np.nan
        if kind == "text" and not cells[rows // 2 :, i].any():
            cells[-1, i] = "OK"
    names = [f"{kind} {i}" for i, kind in enumerate(kinds)]
    lines = ["Bench of Ms. Müller"] * preamble + [delimiter.join(row) for row in (names, *cells)]
    path = written(tmp_path_factory.mktemp("any"), "a.csv", "\n".join([*lines, ""]))
    file = formats.open_bench_file(path)
    assert file.texts == tuple(name for name in names if name.startswith("text"))
    assert file.dialect.skip == preamble + 1
    parts = [*file.pieces([c.name for c in file.channels])]
    for i, kind in enumerate(kinds):
        if kind != "text":
            found = np.concatenate([part.values[names[i]] for part in parts])
            assert found == pytest.approx(np.arange(rows) if kind == "stamp" else numbers[i], nan_ok=True)


@pytest.mark.parametrize("ending", [".csv", ".asc", ".trc"])
def test_a_compressed_file_is_the_same_recording(tmp_path, ending):
    from test_readers import CAN_MAP, write_can

    if ending == ".csv":
        path = table(tmp_path, {"motor [rad]": np.arange(100.0), "flange [rad]": np.arange(100.0) / RATIO})
        inspect(path).write(tmp_path / "map.toml")
    else:
        path = write_can(tmp_path, ending)
        written(tmp_path, "map.toml", MAP + CAN_MAP)
    packed = path.with_name(path.name + ".gz")
    packed.write_bytes(gzip.compress(path.read_bytes()))
    mapping = read_mapping(tmp_path / "map.toml")
    one, other = (RecordingStream(p, mapping).read() for p in (path, packed))
    assert np.array_equal(one.output_angle, other.output_angle)
    assert [note.replace(str(packed), str(path)) for note in other.notes] == [*one.notes]
    packed.write_bytes(packed.read_bytes()[:-20])
    cut = RecordingStream(packed, mapping).read()
    assert cut.time.size <= one.time.size
    assert any("it is truncated or damaged after" in note for note in cut.notes)


def test_what_a_compressed_file_may_not_be_is_one_sentence(tmp_path, monkeypatch):
    packed = tmp_path / "a.csv.gz"
    packed.write_bytes(b"time [s]\n")
    with pytest.raises(edge.InputError, match=r"a\.csv\.gz: this is not a \.gz file"):
        formats.open_bench_file(packed)
    packed.write_bytes(gzip.compress(b"1,2\n" * 1000))
    monkeypatch.setattr("cycloid_fmu.edge.files._MOST_BYTES", 3000)
    with pytest.raises(edge.InputError, match=r"a\.csv\.gz: it unpacks to more than"):
        formats.open_bench_file(packed)
    (tmp_path / "a.rug.gz").write_bytes(packed.read_bytes())
    with pytest.raises(edge.InputError, match=r"a\.rug\.gz: the ending must be one of"):
        formats.open_bench_file(tmp_path / "a.rug.gz")


@measured_drives
@pytest.mark.measured_drives
@pytest.mark.parametrize("name", ["conic_runin5", "onyx_init1", "onyx_runin1", "pccf_init1", "onyx_init1_raw"])
def test_a_drive_that_somebody_measured_is_read_in_all_its_loops(tmp_path, name):
    """Ramps of a motor controller: the loops are the cycles of its command, raw with repeated ticks or averaged."""
    path = next(MEASURED.glob(f"{name}.csv*"))
    found = inspect(path)
    proposed = {role: one.channel.name for role, one in found.roles.items()}
    assert proposed == {"time": "TIME", "output_angle": "POSITION", "torque": "TORQUE"}
    found.write(tmp_path / "map.toml")
    text = (tmp_path / "map.toml").read_text()
    for unit in ("s", "rev", "N*m"):  # the file states none
        text = text.replace('unit = "" ', f'unit = "{unit}" ', 1)
    written(tmp_path, "map.toml", text)
    figures = fitting.metrics(fitting.read_recordings(path, tmp_path / "map.toml"))
    (one,) = figures.surveyed
    command = next(look.values for look in found.looks if look.channel.name == "CONTROL_TORQUE")
    large = np.flatnonzero(np.abs(command) > 0.5 * np.abs(command).max())
    cycles = np.count_nonzero(np.diff(np.sign(command[large])) < 0.0)
    assert len(one.loops.loops) == cycles
    assert one.samples == np.unique(found.roles["time"].values).size


@measured_drives
@pytest.mark.measured_drives
def test_raw_samples_and_their_means_give_the_same_figures(tmp_path):
    text = MAP + 'time = {column = "TIME", unit = "s"}\ntorque = {column = "TORQUE", unit = "N*m"}\n'
    text += 'output_angle = {column = "POSITION", unit = "rev"}\n'
    mapping = written(tmp_path, "map.toml", text)
    raw, means = (
        fitting.metrics(fitting.read_recordings(MEASURED / name, mapping), rated_torque=25.0).figures
        for name in ("onyx_init1_raw.csv.gz", "onyx_init1.csv")
    )
    assert raw.keys() == means.keys()
    for name in means:
        assert raw[name].value == pytest.approx(means[name].value, rel=2e-3), name


def test_counts_are_no_radians(tmp_path):
    """To pint both are numbers; a proposal asks for the counts of a turn, and a mapping needs them."""
    crank = np.arange(3000.0)
    path = table(tmp_path, {"motor [counts]": crank, "flange [deg]": crank, "M [Nm]": crank})
    assert "counts_per_turn = 0" in inspect(path).text
    text = f'{MAP}output_angle = {{column = "motor"}}\ntorque = {{column = "M"}}\n'
    with pytest.raises(edge.InputError, match='the unit "counts" is no angle; state counts_per_turn'):
        RecordingStream(path, read_mapping(written(tmp_path, "map.toml", text)))


def test_a_can_log_and_a_table_have_mappings_of_their_own(tmp_path):
    """The DBC of one mapping names the channels of the log alone."""
    from test_readers import CAN_MAP, write_can

    log = write_can(tmp_path, ".asc")
    run = table(tmp_path, {"motor [rad]": np.arange(500.0), "flange [rad]": np.arange(500.0) / RATIO})
    inspect(run).write(tmp_path / "run.toml")
    written(tmp_path, "log.toml", MAP + CAN_MAP)
    given = [tmp_path / "run.toml", tmp_path / "log.toml"]
    one, other = (source.open() for source in fitting.read_recordings([log, run], given))
    assert one.read().torque == pytest.approx(20.0, abs=1.1)
    assert np.isnan(other.read().torque).all()


@measured_drives
@pytest.mark.measured_drives
@pytest.mark.parametrize("name", ["onyx_init1_raw.csv.gz", "onyx_init1.csv", "onyx_runin1.csv"])
def test_small_loops_have_the_gap_of_a_second_evaluation(tmp_path, name):
    """The first five loops, to ±4 N·m: the distance of the unloading branches at no torque, as evaluated by others."""
    packed = name.endswith(".gz")
    text = (gzip.decompress if packed else bytes)((MEASURED / name).read_bytes()).decode()
    header, *rows = text.splitlines()
    number = header.split(",").index("test_nr")
    small = [row for row in rows if int(row.split(",")[number]) < 5]
    path = written(tmp_path, "small.csv", "\n".join([header, *small, ""]))
    text = MAP + 'time = {column = "TIME", unit = "s"}\ntorque = {column = "TORQUE", unit = "N*m"}\n'
    text += 'output_angle = {column = "POSITION", unit = "rev"}\n'
    found = fitting.metrics(fitting.read_recordings(path, written(tmp_path, "map.toml", text)), rated_torque=4.0)
    figure = found.figures["hysteresis_loss"]
    runs = json.loads((MEASURED / "expected.json").read_text())["runs"]
    expected = runs[name.split(".")[0].removesuffix("_raw")]["zero_torque_gap_deg"]
    assert figure.count == 5
    apart = abs(figure.value - np.radians(expected["value"]))
    assert apart < np.hypot(figure.uncertainty, np.radians(expected["u95"]))


def moteus_log(path, crank, output, torque, *, period=0.005):
    """The log of moteus's own CSV writer: registers by name, no units; each encoder counts its own turn from 0 to 1."""
    names = "MODE POSITION VELOCITY TORQUE Q_CURRENT VOLTAGE TEMPERATURE FAULT CONTROL_TORQUE POSITION_ERROR"
    lines = [",".join(["time", *names.split(), "ENCODER_0_POSITION", "ENCODER_1_POSITION"])]
    for i, (a, b) in enumerate(zip(crank / (2 * np.pi), output / (2 * np.pi), strict=True)):
        measured = [10, a, 1.0, torque, torque / 0.2, 24.0, 31.0, 0, 99.0, 0.001 * np.sin(i), a % 1.0, b % 1.0]
        lines.append(",".join(map(str, [i * period, *measured])))
    path.write_text("\n".join(lines) + "\n")
    return path


def test_the_log_of_a_moteus_goes_to_its_curve_and_maps(command, tmp_path, made):
    """With an encoder on each shaft. The units are the registers', the ratio is that of the angles."""
    files = []
    for load in (20.0, 200.0):
        crank, output = turned(made, load, each=48)
        files.append(moteus_log(tmp_path / f"{load:g}.csv", crank, output, load).name)
    assert command("cycloid-fit", "inspect", files[0], "-o", "map.toml").returncode == 0
    mapping = read_mapping(tmp_path / "map.toml")
    turning, driven = mapping.input_angle, mapping.output_angle
    assert turning.column in ("POSITION", "ENCODER_0_POSITION"), "both are of the motor"
    assert (driven.column, turning.unit, driven.unit) == ("ENCODER_1_POSITION", "rev", "rev")
    assert (mapping.ratio, mapping.time.unit, mapping.torque.column) == (RATIO, "s", "TORQUE")
    curve = command("cycloid-fit", "curve", *files, "--mapping", "map.toml", "-o", "curves.nc")
    assert curve.returncode == 0, curve.stderr
    (first, _) = fitting.read_recordings([tmp_path / name for name in files], mapping=tmp_path / "map.toml")
    (measured,) = fitting.curves(first, RATIO)
    crank, output = turned(made, 20.0, each=48)
    error = output - crank / RATIO
    shown = np.interp(crank, measured.input_angle - measured.input_angle[0], measured.transmission_error)
    assert np.std(shown - error) < 2.0 * NOISE
    maps = command("cycloid-fit", "maps", *files, "--mapping", "map.toml", "-o", "maps.nc")
    assert maps.returncode == 0, maps.stderr
