"""The page on writing an encoder and the examples run as they are."""

import importlib.metadata
import re
import runpy

import pytest
from common import EXAMPLES

from drivers.encoder import Encoder
from drivers.recorder import bench
from drivers.recorder.session import record
from drivers.recording_format import read_recording


def test_the_documented_encoder_records(tmp_path, monkeypatch):
    text = (EXAMPLES.parent / "docs" / "encoder.md").read_text()
    code = re.search(r"<!-- encoder -->\n```python\n(.*?)```", text, re.S)[1]
    (tmp_path / "file_encoder.py").write_text(code)
    monkeypatch.syspath_prepend(str(tmp_path))
    point = importlib.metadata.EntryPoint("file", "file_encoder:FileEncoder", Encoder.group)
    monkeypatch.setattr(bench, "registered", lambda group: importlib.metadata.EntryPoints([point]).select(group=group))
    (tmp_path / "BENCH.toml").write_text(
        'format = "cycloid-bench/1"\n[channel.input_angle]\nprotocol = "file"\npath = "angle.txt"\n'
    )
    (tmp_path / "angle.txt").write_text("180")
    path = tmp_path / "run.arrows"

    gone = []

    def progress(live):
        if live.samples["input_angle"] == 20 and not gone:
            gone.append(True)
            (tmp_path / "angle.txt").unlink()
        elif live.channels["input_angle"].failure is not None:
            (tmp_path / "angle.txt").write_text("90")

    record(tmp_path / "BENCH.toml", path, samples=60, duration=20.0, progress=progress)
    samples = read_recording(path).samples["input_angle"]
    assert samples.value[0] == pytest.approx(3.14159265)
    assert samples.value[-1] == pytest.approx(3.14159265 / 2)
    assert samples.status.nonzero()[0].tolist() == [20], "supervision is the recorder's, not the encoder's"


@pytest.mark.parametrize(
    ("example", "said"),
    [
        ("record_can.py", r"input_angle: 192 samples in rad; .*TE -4\.\d+ arcsec mean"),
        ("record_serial.py", r"\d{3} lines; marks .* uncertainty \d+ us"),
    ],
)
def test_the_examples_run(tmp_path, monkeypatch, capsys, example, said):
    monkeypatch.chdir(tmp_path)
    runpy.run_path(str(EXAMPLES / example), run_name="__main__")
    printed = capsys.readouterr().out
    assert re.search(said, printed, re.S), printed
