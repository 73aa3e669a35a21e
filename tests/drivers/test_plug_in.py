"""Encoders of other packages: found by their installation, never by the content of a bench file."""

import importlib
import inspect
import pkgutil
import re
import socket
import sys
from importlib import metadata

import pytest
from common import EXAMPLES

import drivers
import drivers.encoders
from cycloid_fmu import edge
from drivers.encoder import Encoder, protocols
from drivers.recorder.bench import read_bench
from drivers.recording_format import GAP

ENCODER = '''
from drivers.encoder import AngleConfig, Encoder, channel_of, steady_time
from drivers.recording_format import Samples

class CounterConfig(AngleConfig):
    """Counts from `begin`."""
    begin: int = 0

class Counter(Encoder):
    configuration = CounterConfig

    def __init__(self, name, config, line=None):
        super().__init__(name, config, line)
        self.count = config.begin

    def __enter__(self):
        self.channel = channel_of(self.name, self.config, identity="rig", time_source="host clock: the call")
        return self

    def read(self, timeout):
        self.count += 1
        return Samples.checked(self.name, [steady_time()], [0.5 * self.count], counts=[self.count])

    def events(self):
        return []

    def close(self):
        pass
'''
BENCH = 'format = "cycloid-bench/1"\n[channel.output_angle]\nprotocol = "{}"\n'


@pytest.fixture
def installed(tmp_path, monkeypatch):
    """Install a package into its own folder, with the layout of pip."""
    site = tmp_path / "site"
    site.mkdir()
    monkeypatch.syspath_prepend(str(site))

    def install(name, protocol, value, code=ENCODER):
        (site / f"{name}.py").write_text(code)
        folder = site / f"{name}-1.0.dist-info"
        folder.mkdir()
        (folder / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
        (folder / "entry_points.txt").write_text(f"[{Encoder.group}]\n{protocol} = {value}\n")
        importlib.invalidate_caches()

    yield install
    for module in [m for m in sys.modules if (site / f"{m}.py").exists()]:
        del sys.modules[module]


def bench(tmp_path, protocol, keys=""):
    path = tmp_path / "BENCH.toml"
    path.write_text(BENCH.format(protocol) + keys)
    return path


def test_an_installed_package_provides_an_encoder(tmp_path, installed, command):
    installed("rig_plug_in", "rig", "rig_plug_in:Counter")
    assert ", rig" in command("cycloid-bench", "list").stdout.splitlines()[0]
    done = drivers.record(bench(tmp_path, "rig", "begin = 7\n"), tmp_path / "run.arrows", samples=50)
    samples = drivers.read_recording(done.path).samples["output_angle"]
    assert samples.counts[:3].tolist() == [8, 9, 10]
    assert samples.value[0] == 4.0
    with pytest.raises(edge.InputError, match=r"\[channel.output_angle\].*beginn"):
        read_bench(bench(tmp_path, "rig", "beginn = 7\n"))


def test_the_package_s_own_protocols_are_registered_the_same_way():
    own = {e.value for e in metadata.distribution("cycloid-fmu").entry_points if e.group == Encoder.group}
    for module in pkgutil.iter_modules(drivers.encoders.__path__):
        loaded = importlib.import_module(f"drivers.encoders.{module.name}")
        classes = [c for c in vars(loaded).values() if inspect.isclass(c) and c.__module__ == loaded.__name__]
        speak = [c for c in classes if issubclass(c, Encoder) and not inspect.isabstract(c)]
        assert any(f"{loaded.__name__}:{c.__name__}" in own for c in speak), module.name
    assert {protocols()[n].value for n in ("canopen", "modbus")} <= own


@pytest.mark.parametrize(
    "protocol", ["own_code:Counter", "./own_code.py", "os:system", "drivers.encoders.modbus:ModbusEncoder", "own_code"]
)
def test_a_file_never_names_code(tmp_path, monkeypatch, protocol):
    (tmp_path / "own_code.py").write_text("raise SystemExit('ran')\n" + ENCODER)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(edge.InputError, match="no such protocol is installed"):
        read_bench(bench(tmp_path, protocol))
    assert "own_code" not in sys.modules


@pytest.mark.parametrize(
    ("value", "code", "said"),
    [
        (
            "broken_rig:Counter",
            "import no_such_package_at_all\n",
            "broken_rig that provides it does not load: No module named",
        ),
        ("broken_rig:Counter", "x = 1\n", "broken_rig that provides it does not load: .*Counter"),
        ("broken_rig:Counter", "1 / 0\n", "does not load: division by zero"),
        ("broken_rig:Counter", "Counter = dict\n", "must provide a subclass of Encoder with a configuration"),
    ],
)
def test_a_broken_package_is_reported_in_one_sentence(tmp_path, installed, value, code, said):
    installed("broken_rig", "broken", value, code)
    with pytest.raises(edge.InputError, match=said) as problem:
        read_bench(bench(tmp_path, "broken"))
    assert len(str(problem.value).splitlines()) == 1


def test_a_protocol_name_in_use_is_refused(tmp_path, installed):
    installed("second_modbus", "modbus", "second_modbus:Counter")
    both = "the packages cycloid-fmu and second_modbus both provide it; uninstall one"
    with pytest.raises(edge.InputError, match=both):
        read_bench(bench(tmp_path, "modbus"))


@pytest.fixture
def guide(installed):
    """The plug-in of the page on writing one, installed; returns its bench file for a free port."""
    page = (EXAMPLES.parent / "docs" / "development" / "add_an_encoder.md").read_text(encoding="utf-8")
    files = dict(re.findall(r":caption: (\S+)\n(.*?)```", page, re.S))
    installed("udp_encoder", "lab_udp", "udp_encoder:UdpEncoder", files["udp_encoder.py"])
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    return files["bench.toml"].replace("47123", str(port)), port


def test_a_plug_in_s_channels_share_its_own_line_and_count_what_is_lost(tmp_path, guide):
    (tmp_path / "BENCH.toml").write_text(guide[0])
    numbers = [n for n in range(1, 201) if n % 40 and not 101 <= n <= 103]
    sent = []

    def send(live):
        """Send the readings one by one once the recording runs."""
        if len(sent) < len(numbers):
            number = numbers[len(sent)]
            sent.append(number)
            sender.sendto(f"{number};{number / 100};{3 * number};{-number}".encode(), ("127.0.0.1", guide[1]))

    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        path = tmp_path / "run.arrows"
        done = drivers.record(tmp_path / "BENCH.toml", path, samples=len(numbers), duration=30.0, progress=send)
    assert done.ended == "samples"
    assert dict(done.lost) == {"input_angle": 7, "output_angle": 7}  # 40, 80, 120, 160 and three in a row
    recording = drivers.read_recording(path)
    turning, driven = recording.samples["input_angle"], recording.samples["output_angle"]
    assert (turning.time_host == driven.time_host).all()
    assert (turning.counts.tolist(), driven.counts.tolist()) == ([3 * n for n in numbers], [-n for n in numbers])
    marked = [n for n, status in zip(numbers, turning.status, strict=True) if status & GAP]
    assert marked == [41, 81, 104, 121, 161]


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("port = ", "prt = ", r"\[udp.rig\] prt is not a known key"),
        ('udp = "rig"', 'udp = "other"', r'udp = "other": there is no udp of this name; the file has "rig"'),
        ("[udp.rig]", "[tcp.rig]", "tcp is not a known key"),
        ('protocol = "lab_udp"', 'protocol = "ascii"', "udp is not a known key"),
    ],
)
def test_a_plug_in_s_table_is_checked_as_the_others_are(tmp_path, guide, old, new, said):
    (tmp_path / "BENCH.toml").write_text(guide[0].replace(old, new))
    with pytest.raises(edge.InputError, match=said):
        read_bench(tmp_path / "BENCH.toml")


def test_a_table_that_another_package_has_is_refused(tmp_path, installed, guide):
    line = (
        "from drivers.lines import LineConfig\nclass Other(LineConfig):\n    kind = 'udp'\n    noun = 'x'\n"
        "    address = property(lambda self: 'x')\nCounter.line = Other\n"
    )
    installed("other_rig", "other", "other_rig:Counter", ENCODER + line)
    (tmp_path / "BENCH.toml").write_text(guide[0] + '[channel.torque]\nprotocol = "other"\n')
    with pytest.raises(edge.InputError, match=r"\[channel.torque\]: its package's table \[udp.NAME\] is another"):
        read_bench(tmp_path / "BENCH.toml")
