"""Every reader, with files in which bits flip, bytes come and go and values change: it reads, or gives the reason.

The reason is the package's own error, with the name of the file.
"""

import dataclasses
import functools
import json
import logging
import zlib

import can
import cantools
import ezdxf
import hostile
import numpy as np
import pyarrow as pa
import pytest
from common import EXAMPLES, damaged, make_pair, study_size
from pyarrow import parquet

import cycloid_fmu as cy
from cycloid_fmu import edge
from cycloid_fmu.bodies.given import read_influence, write_influence
from cycloid_fmu.bodies.outline import windows
from cycloid_fmu.bodies.ports import PortMatrix
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.edge import limited
from cycloid_fmu.fmu.bench_losses import read_bench_losses
from cycloid_fmu.fmu.build import build_fmu, read_losses
from cycloid_fmu.fmu.friction_file import read_friction
from cycloid_fmu.fmu.run import read_motion, stated_drive, units_of
from cycloid_fmu.geometry.bodies import DiscBody
from cycloid_fmu.reducer.description import read_reducer
from cycloid_fmu.studies.checkpoint import Checkpoint
from cycloid_fmu.studies.limits import read_requirements
from cycloid_fmu.studies.tolerance import Study
from cycloid_fmu.surfaces.measuring import measured_surface, read_points
from cycloid_fmu.surfaces.surface import Ageing, Life, surface_of_pair
from cycloid_fmu.wear.law import read_duty_cycle, read_wear_law
from drivers.recorder.bench import read_bench
from drivers.recorder.sequence import read_sequence
from drivers.recording_format import RecordingWriter, Samples
from drivers.recording_format.repair import repair
from drivers.simulated.buses import read_simulation
from fitting.ageing.history import History, measured, read_history
from fitting.estimation.result import read_lmfit_parameters
from fitting.figures.comparison import read_figures
from fitting.readers.inspection import inspect
from fitting.readers.mapping import read_mapping
from fitting.readers.read_head import read_read_head
from fitting.readers.recording import RecordingStream
from tests.cycloid_fmu.cmm import measure, write_csv
from tests.drivers.test_can_more import EDS
from tests.drivers.test_recording_format import HEADER
from tests.drivers.test_sequence import SEQUENCE
from tests.fitting.test_readers import CAN_MAP, DBC
from tests.fitting.test_scope import export

COUNT = study_size("CYCLOID_DAMAGED_FILES", 200, 2e4)
SAMPLES = 24
TIME = np.arange(SAMPLES) * 1e-2
OWN = {
    "time": ("s", TIME),
    "input_angle": ("rad", 20.0 * TIME),
    "output_angle": ("rad", -20.0 * TIME / 39),
    "torque": ("N*m", 20.0 + np.sin(TIME)),
}
SMALL = make_pair(gear_teeth=6, pins=7, pin_circle_radius="40 mm", eccentricity="2.5 mm", pin_radius="6 mm")
ERRORS = """[errors]
centre_distance_x = "5 um"
pin_radial = { order_1 = ["3 um", "40 deg"] }
tooth_cumulative_pitch = { order_2 = ["2 um", "0 deg"] }
"""
BENCH = """format = "cycloid-bench/1"
ratio = -39
pair = "39/40"
[conditions]
load = "20 N*m"
direction = "forward"
[bus.can0]
interface = "virtual"
channel = "v"
[port.usb]
url = "/dev/ttyUSB0"
baud_rate = 2000000
[channel.input_angle]
protocol = "canopen"
bus = "can0"
node = 5
counts_per_turn = 4194304
eds = "encoder.eds"
[channel.output_angle]
protocol = "amt21"
port = "usb"
address = 84
"""
BODIES = (
    SMALL.replace(supports={"kind": "cranks", "count": 3, "circle_radius": "16 mm"}).text
    + """[bodies]
disc_spacing = "11 mm"
[bodies.disc]
bore_radius = "6 mm"
centre_radius = "5 mm"
[[bodies.disc.windows]]
shape = "fan"
count = 3
first_angle = "60 deg"
inner_radius = "14 mm"
outer_radius = "20 mm"
half_angle = "12 deg"
corner_radius = "1 mm"
[[bodies.disc.windows]]
shape = "polygon"
x = ["24 mm", "25 mm", "25 mm"]
y = ["0 mm", "0 mm", "1 mm"]
[bodies.crank]
bearings = ["-19 mm", "19 mm"]
sections = [{ from = "-19 mm", to = "0 mm", diameter = "15 mm" }, { from = "0 mm", to = "19 mm", diameter = "15 mm" }]
[bodies.ring]
outer_radius = "52 mm"
width = "24 mm"
"""
)
INFLUENCE = "held:0,seat:0:0.05:0:1:0,seat:0:0.05:0:0:1\nseat:0:0.05:0:1:0,2e-9,5e-10\nseat:0:0.05:0:0:1,5e-10,1e-9\n"
SLOT = {"shape": "polygon"}
SENSOR = """[channel.torque]
protocol = "dbc"
bus = "can0"
file = "bench.dbc"
message = "Sensor"
signal = "Moment"
"""
MAPPING = """format = "cycloid-mapping/1"
ratio = -39
[time]
column = "time"
[input_angle]
column = "input_angle"
unit = "rad"
rollover = "360 deg"
delay = "1.2 ms"
[output_angle]
column = "output_angle"
direction = -1
[torque]
column = "torque"
"""
HISTORY = """format = "cycloid-history/1"
crank_turns_per_hour = 9e4
torque = "-20 N*m"
in_service = 2026-01-05
hours_per_day = 16
[limits]
lost_motion = "1.6 arcmin"
[bearing]
name = "turning_arm"
clearance_growth = "5 um"
within = "10000 h"
[[recorded]]
date = 2026-02-10
lost_motion = ["1.26 arcmin", "0.02 arcmin"]
[[recorded]]
age = "900 h"
figures = "f.json"
"""
HISTORY_OF_FILE = History(crank_turns_per_hour=9e4, recorded=[{"age": "1 h", "figures": "f.json"}])
FIGURE = {
    "value": 1e-4,
    "uncertainty": None,
    "unit": "rad",
    "definition": "as the standard says",
    "interval": [0.0, 20.0],
    "interval_unit": "N*m",
    "turns": 1,
    "forward": {
        "value": 1e-4,
        "uncertainty": 1e-6,
        "unit": "rad",
        "definition": "",
        "interval": None,
        "interval_unit": "",
        "turns": 1,
    },
}
PARAMETERS = [
    [name, 1e-6, True, None, -1e-3, 1e-3, None, 1e-7, {}, 0.0, None] for name in ("pin_radial_1_cos", "offset")
]


def text_file(name, text):
    def make(folder):
        (folder / name).write_text(text, encoding="utf-8")
        return folder / name

    return make


def example(name, *beside):
    def make(folder):
        for one in (name, *beside):
            (folder / one).write_bytes((EXAMPLES / one).read_bytes())
        return folder / name

    return make


def influence(folder):
    """The matrix of two ports of a ring."""
    kind, place = np.array(["seat", "seat"]), np.array([0.05, 0.05], dtype=complex)
    compliance = np.array([[2.0, 0.5], [0.5, 1.0]]) * 1e-9
    ports = PortMatrix(kind, np.array([0, 0]), place, np.array([1.0, 1j]), compliance, "held")
    write_influence(ports, folder / "ring.nc")
    return folder / "ring.nc"


def dxf(folder):
    document = ezdxf.new("R2000", units=ezdxf.units.MM)
    document.modelspace().add_lwpolyline(
        [(20.0, -3.0), (28.0, -3.0, 0.0, 0.0, 1.0), (28.0, 3.0), (20.0, 3.0)], close=True
    )
    document.saveas(folder / "slot.dxf")
    return folder / "slot.dxf"


def surface(folder):
    drive = cy.Drive(SMALL).replace(errors={"pin_radius": "-1 um"})
    drive.write(folder / "made.nc")
    return folder / "made.nc"


def twin(folder):
    """A surface whose life passes with age."""
    shapes = {"gear_deviation": (1, 6, 1, 1), "pin_deviation": (7, 1, 1)}
    flat = {**shapes, "gear_curvature": shapes["gear_deviation"], "pin_curvature": shapes["pin_deviation"]}
    states = [np.zeros((2, *shape)) for shape in flat.values()]
    life = Life(np.array([0.0, 1e6]), *states, ageing=Ageing(25.0, 1e4, 3e4))
    made = {name: values[-1] for name, values in zip(flat, states, strict=True)}
    cy.Drive(SMALL, surface_of_pair(SMALL).replace(**made, life=life, origin="worn")).write(folder / "twin.nc")
    return folder / "twin.nc"


def dated_figures(folder):
    figures = {"format": "cycloid-figures/1", "lost_motion": {**FIGURE, "uncertainty": 1e-6}}
    return text_file("f.json", json.dumps(figures))(folder)


def table(folder):
    rows = zip(*(values for _, values in OWN.values()), strict=True)
    lines = [",".join(f"{n} [{u}]" for n, (u, _) in OWN.items()), *(",".join(f"{v:.9g}" for v in r) for r in rows)]
    return text_file("run.csv", "\n".join(lines) + "\n")(folder)


def scope(folder):
    groups = [((TIME * 1e3).tolist(), {n: v.tolist() for n, (_, v) in OWN.items() if n != "time"})]
    return text_file("run.csv", export(groups, units={n: u for n, (u, _) in OWN.items()}))(folder)


def parquet_table(folder):
    fields = [pa.field(n, pa.float64(), metadata={"unit": u}) for n, (u, _) in OWN.items()]
    parquet.write_table(pa.table([v for _, v in OWN.values()], pa.schema(fields)), folder / "run.parquet")
    return folder / "run.parquet"


def mdf(version, compression):
    def make(folder):
        asammdf = pytest.importorskip("asammdf")
        with asammdf.MDF(version=version) as file:
            file.append([asammdf.Signal(v, TIME, unit=u, name=n) for n, (u, v) in OWN.items() if n != "time"])
            path = file.save(folder / "run", compression=compression)
        if version < "4":  # its channels name no unit of their own
            tables = [f'[{n}]\ncolumn = "{n}"\nunit = "{u}"\n' for n, (u, _) in OWN.items() if n != "time"]
            (folder / "map.toml").write_text('format = "cycloid-mapping/1"\n' + "".join(tables))
        return path

    return make


def tdms(folder):
    nptdms = pytest.importorskip("nptdms")
    with nptdms.TdmsWriter(str(folder / "run.tdms")) as writer:
        writer.write_segment([nptdms.ChannelObject("run", n, v, {"unit_string": u}) for n, (u, v) in OWN.items()])
    return folder / "run.tdms"


def can_log(suffix):
    def make(folder):
        (folder / "bench.dbc").write_text(DBC)
        (folder / "map.toml").write_text('format = "cycloid-mapping/1"\n' + CAN_MAP)
        database = cantools.database.load_string(DBC, "dbc")
        with can.Logger(folder / f"run{suffix}") as log:
            for at, turned, driven, torque in zip(*(v for _, v in OWN.values()), strict=True):
                angles = database.encode_message("Angles", {"Motor": turned, "Abtrieb": driven})
                sensor = database.encode_message("Sensor", {"Moment": torque})
                for number, data in ((291, angles), (292, sensor)):
                    log.on_message_received(can.Message(1e3 + at, number, is_extended_id=False, data=data))
        return folder / f"run{suffix}"

    return make


def recording(folder):
    units = {n: u for n, (u, _) in OWN.items()}
    channels = tuple(dataclasses.replace(c, unit=units[c.name]) for c in HEADER.channels)
    with RecordingWriter(folder / "run.arrows", dataclasses.replace(HEADER, channels=channels)) as writer:
        for begin in range(0, SAMPLES, 8):
            for channel in channels:
                part = slice(begin, begin + 8)
                writer.write(Samples.checked(channel.name, TIME[part], OWN[channel.name][1][part]))
    return folder / "run.arrows"


def points(folder):
    return write_csv(folder / "points.csv", measure(SMALL, surface_of_pair(SMALL), 5e-7, 1, along=9, across=2))


def fmu(folder):
    build_fmu(DriveValue.as_stated(SMALL), folder / "drive.fmu")
    return folder / "drive.fmu"


def bench(folder):
    (folder / "encoder.eds").write_text(EDS)
    (folder / "bench.dbc").write_text(DBC)
    return text_file("BENCH.toml", BENCH + SENSOR)(folder)


def encoder(folder):
    (folder / "encoder.eds").write_text(EDS)
    return text_file("BENCH.toml", BENCH[: BENCH.index("[channel.output")])(folder)


def sensor(folder):
    (folder / "bench.dbc").write_text(DBC)
    return text_file("BENCH.toml", BENCH[: BENCH.index("[channel")] + SENSOR)(folder)


def beside(make, name):
    """Another of the files that `make` writes."""
    return lambda folder: make(folder).with_name(name)


@functools.cache
def study():
    return Study(SMALL, cy.read_tolerances(EXAMPLES / "tolerances.toml"), torque=(20.0,), samples=8, seed=1)


def checkpoint(folder):
    path = folder / "study.checkpoint"
    Checkpoint(path, study()).add(np.arange(2), np.zeros((2, len(study().columns))), ("", "no such drive"))
    return path


def read_signed_checkpoint(path):
    """A checkpoint with a correct CRC-32 of any header."""
    header, _, rest = path.read_bytes().partition(b"\n")
    text = header.partition(b" ")[2]
    path.write_bytes(f"{zlib.crc32(text):08x} ".encode() + text + b"\n" + rest)
    Checkpoint(path, study())


def read_run(path):
    """As `cycloid-fit` takes a recording."""
    RecordingStream(
        path, read_mapping(path.with_name("map.toml")) if path.with_name("map.toml").exists() else None
    ).read()


def inspected(path):
    dbc = path.with_name("bench.dbc")
    _ = inspect(path, dbc if dbc.exists() else None).text


READERS = {
    "pair": (text_file("pair.toml", SMALL.text + ERRORS), cy.read_drive),
    "reducer": (example("rv-20e.toml"), read_reducer),
    "tolerances": (example("tolerances.toml"), cy.read_tolerances),
    "requirements": (example("requirements.toml"), read_requirements),
    "wear": (example("wear.toml"), read_wear_law),
    "friction": (example("friction.toml"), read_friction),
    "measured losses": (
        text_file("b.csv", "speed [rpm],torque [N*m],loss [N*m],temperature [K]\n0,0,.1,293\n0,9,.2,293\n0,9,.1,313"),
        lambda path: read_bench_losses(path, 39.0),
    ),
    "duty cycle": (text_file("duty.csv", "torque [N*m],crank_turns [1]\n20,1e6\n-200,2.5e5\n"), read_duty_cycle),
    "losses": (
        text_file("l.csv", "speed [rpm],eta_mf1 [1],eta_mf2 [1],tau_bf1 [N*m],tau_bf2 [N*m]\n0,.9,.8,.1,.2\n9,1,1,0,0"),
        read_losses,
    ),
    "bodies": (text_file("bodies.toml", BODIES), cy.read_drive),
    "influence": (influence, lambda path: read_influence(path, 1e-3)),
    "influence as CSV": (text_file("ring.csv", INFLUENCE), lambda path: read_influence(path, 1e-3)),
    "DXF": (dxf, lambda path: windows(DiscBody(bore_radius="9 mm", windows=[{**SLOT, "dxf": str(path)}]))),
    "surface": (surface, cy.read_surface),
    "twin": (twin, cy.read_surface),
    "history": (text_file("history.toml", HISTORY), read_history),
    "dated figures": (dated_figures, lambda path: measured(HISTORY_OF_FILE, cy.Drive(SMALL), path.parent)),
    "points": (points, lambda path: measured_surface(SMALL, read_points(path))),
    "motion": (table, lambda path: read_motion(path, {"flange_a.phi": "rad", "flange_b.phi": "rad"})),
    "FMU": (fmu, lambda path: (stated_drive(path), units_of(path, "output"))),
    "checkpoint": (checkpoint, lambda path: Checkpoint(path, study())),
    "checkpoint that is signed": (checkpoint, read_signed_checkpoint),
    "bench": (bench, read_bench),
    "EDS": (beside(encoder, "encoder.eds"), lambda path: read_bench(path.with_name("BENCH.toml"))),
    "DBC": (beside(sensor, "bench.dbc"), lambda path: read_bench(path.with_name("BENCH.toml"))),
    "sequence": (lambda f: (bench(f), text_file("sequence.toml", SEQUENCE)(f))[1], read_sequence),
    "simulation": (
        text_file(
            "s.toml", 'format = "cycloid-simulation/1"\n[[amt21.faults]]\nkind = "pull"\nsample = 3\nby = "200 ms"\n'
        ),
        read_simulation,
    ),
    "recording": (recording, read_run),
    "repair": (recording, repair),
    "CSV": (table, read_run),
    "TwinCAT Scope": (scope, read_run),
    "Parquet": (parquet_table, read_run),
    "MDF3": (mdf("3.30", 0), read_run),
    "MDF4": (mdf("4.10", 0), read_run),
    "MDF4 compressed": (mdf("4.10", 2), read_run),
    "TDMS": (tdms, read_run),
    "BLF": (can_log(".blf"), read_run),
    "ASC": (can_log(".asc"), read_run),
    "TRC": (can_log(".trc"), read_run),
    "DBC of a log": (beside(can_log(".asc"), "bench.dbc"), lambda path: read_run(path.with_name("run.asc"))),
    "mapping": (
        lambda f: (table(f), text_file("map.toml", MAPPING)(f))[1],
        lambda path: read_run(path.with_name("run.csv")),
    ),
    "CSV inspected": (table, inspected),
    "read head": (example("rv-20e-read-head.toml", "rv-20e-tilt.csv"), read_read_head),
    "displacements": (
        beside(example("rv-20e-read-head.toml", "rv-20e-tilt.csv"), "rv-20e-tilt.csv"),
        lambda path: read_read_head(path.with_name("rv-20e-read-head.toml")),
    ),
    "figures": (
        text_file("f.json", json.dumps({"format": "cycloid-figures/1", "angular_transmission_error": FIGURE})),
        read_figures,
    ),
    "identification": (
        text_file(
            "fit.json", json.dumps({"format": "cycloid-identification/1", "lmfit_parameters": {"params": PARAMETERS}})
        ),
        read_lmfit_parameters,
    ),
}


# Files that stopped the program, or would have; each is read once, and damaged further now and then.
SEEDS = {
    "MDF4": hostile.self_linked_group,
    "MDF4 compressed": hostile.compressed_bomb,
    "DBC": hostile.endless_signal,
    "DBC of a log": hostile.far_signal,
    "surface": hostile.far_member,
    "twin": hostile.far_member,
}


# The remains of a library's failed constructor raise warnings when they are freed.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning", "ignore::RuntimeWarning")
@pytest.mark.parametrize("count", [2, pytest.param(COUNT, marks=pytest.mark.slow(10))])
@pytest.mark.parametrize(
    "name",
    # Their readers are processes of their own, which the worst files keep busy until the time is over.
    [pytest.param(name, marks=pytest.mark.system if name.startswith(("DBC", "MDF4")) else ()) for name in READERS],
)
def test_a_damaged_file_is_read_or_refused_in_one_sentence(tmp_path, request, monkeypatch, name, count):
    make, read = READERS[name]
    path = make(tmp_path)
    read(path)
    request.addfinalizer(lambda: logging.disable(logging.NOTSET))
    logging.disable(logging.CRITICAL)  # messages of libraries about each file would be kept until the end
    monkeypatch.setattr(limited, "_SECONDS", 2.0)
    whole, kept = path.read_bytes(), tmp_path / "wrong"
    seed = SEEDS[name](whole) if name in SEEDS else whole
    random = np.random.default_rng([zlib.crc32(name.encode()), count])
    said = []
    for number in range(count):
        data = damaged(random, seed if number % 500 == 499 else whole) if number else seed
        path.write_bytes(data)
        try:
            with hostile.within(20.0, 2 << 30):
                read(path)
        except edge.InputError as refused:
            said += str(refused).splitlines()  # a sentence a problem
        except BaseException:
            kept.write_bytes(data)
            raise
    assert said or count < 100
    assert [one for one in said if str(tmp_path) not in one or len(one) > 2000] == []
    # Readers in a process of their own; and Arrow reserves what a page states, but fills none of it.
    exempt = path.suffix in (".blf", ".asc", ".trc", ".dbc", ".mf4", ".mdf", ".nc", ".tdms", ".parquet")
    assert exempt or not any("more memory than there is" in one for one in said)


@pytest.mark.parametrize("number", ["1e308", "-1e308", ".1e308", "1e160"])
@pytest.mark.parametrize("name", ["measured losses", "losses", "points", "duty cycle", "motion"])
def test_a_number_beyond_measure_is_refused_before_it_is_squared(tmp_path, capfd, name, number):
    make, read = READERS[name]
    path = make(tmp_path)
    lines = path.read_text().splitlines()
    first = next(i for i, line in enumerate(lines) if "[" in line)
    column = next(i for i, cell in enumerate(lines[first].split(",")) if "[" in cell)
    cells = lines[first + 1].split(",")
    cells[column] = number
    path.write_text("\n".join([*lines[: first + 1], ",".join(cells), *lines[first + 2 :]]))
    with pytest.raises(edge.InputError, match=rf"{path.name}: line {first + 2}: .* = \"{number}\": it must be within"):
        read(path)
    assert capfd.readouterr().err == ""


@pytest.mark.slow(2)
def test_what_libraries_log_and_complain_of_is_not_printed(tmp_path, installed_command):
    whole = tdms(tmp_path).read_bytes()
    (tmp_path / "run.tdms").write_bytes(whole[:-3].replace(b"unit_string", b"unit_stri\xa5g"))
    done = installed_command("cycloid-fit", "inspect", "run.tdms")
    assert {line.partition(" ")[0] for line in done.stderr.splitlines()} == {"run.tdms:"}
    (tmp_path / "run.mf4").write_bytes(mdf("4.10", 0)(tmp_path).read_bytes()[:700])
    done = installed_command("cycloid-fit", "inspect", "run.mf4")
    assert (done.returncode, done.stdout, len(done.stderr.splitlines())) == (2, "", 1)
