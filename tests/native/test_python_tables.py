"""The FMU in Python that interpolates the native FMU's tables: its file, its inputs, its state and its table."""

import struct
import zipfile

import fmpy
import numpy as np
import pytest
from c_host import INTERFACES
from common import ARCSEC, EXAMPLES
from fmpy.validation import validate_fmu
from hypothesis import given, settings
from hypothesis import strategies as st

from cycloid_fmu.fmu import table_teeth, tables
from cycloid_fmu.fmu.build import build_fmu
from cycloid_fmu.fmu.core import Core, state_from_bytes, state_to_bytes
from cycloid_fmu.fmu.model import DriveModel
from cycloid_fmu.fmu.run import follow
from cycloid_fmu.fmu.variables import Interface


@pytest.fixture(scope="module")
def fmu(drive, tmp_path_factory):
    folder, made = tmp_path_factory.mktemp("tables"), {}

    def one(version="2.0", kind="kinematic"):
        if (version, kind) not in made:
            path = made[version, kind] = folder / f"{kind}{version[0]}.fmu"
            build_fmu(
                drive.pair, drive.surface, path, interface=INTERFACES[kind], fmi_version=version, tables=drive.tables
            )  # fmt: skip
        return made[version, kind]

    return one


@pytest.fixture
def core(fmu, tmp_path):
    """The model behind an FMU, started, with its references by name."""

    def one(kind="kinematic"):
        with zipfile.ZipFile(fmu(kind=kind)) as archive:
            archive.extractall(tmp_path / kind)
        found = Core(tmp_path / kind / "resources", "2.0")
        found.start()
        return found, {v.name: reference for reference, v in found.table.items()}

    return one


@pytest.mark.parametrize("version", ["2.0", "3.0"])
def test_the_file_is_valid_and_differs_from_the_native_one_in_no_variable(fmu, built, version):
    assert validate_fmu(str(fmu(version))) == []
    described, native = (fmpy.read_model_description(str(path)) for path in (fmu(version), built(version=version)))
    assert described.coSimulation.needsExecutionTool
    assert described.description.endswith(native.description.split("kinematic, ")[1])
    ours, theirs = (
        {(v.name, v.valueReference, v.causality, v.variability, v.start) for v in d.modelVariables}
        for d in (described, native)
    )
    assert ours == theirs


def test_it_follows_the_exact_model_through_a_host(fmu, drive, built):
    angles = np.linspace(0.0, 30.0, 150)
    torques = 300.0 * np.cos(angles) * (np.arange(150) % 10 > 2)
    names = ("flange_b.phi", "flange_a.tau", "transmission_error")
    found, native = (follow(path, angles, torques, names) for path in (fmu(), built()))
    for name in names:
        np.testing.assert_allclose(found[name], native[name], rtol=0.0, atol=1e-9 * np.abs(native[name]).max())
    model = DriveModel(drive.pair, drive.surface)
    for i, (angle, torque) in enumerate(zip(angles, torques, strict=True)):
        model.crank_angle, model.torque = angle, torque
        model.advance()
        assert found["transmission_error"][i] == pytest.approx(model.transmission_error, abs=0.02 * ARCSEC)


def test_what_the_tables_hold_can_be_read_and_not_set(core):
    one, v = core()
    before = one.getters[v["pin_radial_1_cos"]]()
    assert one.put(v["pin_radial_1_cos"], before) == ""
    said = one.put(v["pin_radial_1_cos"], 2e-6)
    assert said.startswith("pin_radial_1_cos = 2e-06: this FMU holds it in its tables, made for 0; build the FMU again")
    assert one.getters[v["pin_radial_1_cos"]]() == before
    assert "no step before this is set right" in one.step(0.0, 1e-3)
    assert one.put(v["pin_radial_1_cos"], before) == one.step(0.0, 1e-3) == ""


@pytest.mark.parametrize(
    ("kind", "values", "said"),
    [
        ("kinematic", {"flange_b.tau": 1e9}, "1e+09 N.m: the FMU's table reaches 452.5 N.m"),
        (
            "compliant",
            {"flange_b.phi": 0.009},
            "0.009 rad from flange_a.phi/ratio, where the torque is beyond the 452.5",
        ),
    ],
)
def test_a_step_out_of_the_tables_is_refused_and_leaves_all_as_it_was(core, kind, values, said):
    one, v = core(kind)
    one.put(v["flange_a.phi"], 0.0)
    assert one.step(0.0, 1e-3) == ""
    before = one.state()
    kept = {name: one.getters[v[name]]() for name in values}
    for name, value in values.items():
        one.put(v[name], value)
    assert said in one.step(0.0, 1e-3)
    for name, value in kept.items():
        one.put(v[name], value)
    assert one.state() == before


@pytest.mark.parametrize("kind", ["kinematic", "compliant"])
def test_a_state_repeats_the_same_bits_in_another_instance(core, kind):
    (one, v), (other, _) = core(kind), core(kind)
    random = np.random.default_rng(5)
    push = "flange_b.tau" if kind == "kinematic" else "flange_b.phi"

    def walk(core, seed):
        found, draw = [], np.random.default_rng(seed)
        for _ in range(20):
            crank = draw.normal()
            core.put(v["flange_a.phi"], crank)
            core.put(
                v[push], draw.normal(0.0, 80.0) if kind == "kinematic" else crank / -39 + draw.uniform(-2e-4, 2e-4)
            )
            assert core.step(0.0, 1e-4) == ""
            found.append([core.getters[r]() for r, variable in core.table.items() if variable.causality == "output"])
        return found

    for _ in range(4):
        walk(one, random.integers(1000))
        blob = state_to_bytes(one.state())
        wanted = walk(one, 1)
        other.restore(state_from_bytes(blob))
        assert walk(other, 1) == wanted


def test_the_command_builds_it_and_says_how_good_the_tables_are(command, drive, tmp_path, monkeypatch):
    monkeypatch.setattr(tables, "compute", lambda *drive_, **told: drive.tables)
    done = command("cycloid-fmu", "build", EXAMPLES / "drive-39-40.toml", "--tables", "-o", "drive.fmu")
    assert done.returncode == 0
    assert "up to 452.5 N*m; transmission error within 0.0" in done.stdout
    with zipfile.ZipFile(tmp_path / "drive.fmu") as archive:
        data = archive.read(f"resources/{table_teeth.TABLE}")
    assert table_teeth.read(data, "drive.table").largest == (452.5, 452.5)


# --- the table's file ---


def arrays(draw, shape, most):
    values = draw(st.lists(st.integers(-most, most), min_size=int(np.prod(shape)), max_size=int(np.prod(shape))))
    return np.array(values, dtype=float).reshape(shape)


@st.composite
def any_tables(draw):
    """Tables of whole steps of any size and sign; no drive's."""
    angles = draw(st.integers(4, 8))
    told = draw(st.integers(4, angles))
    sides = []
    for _ in range(2):
        loads = draw(st.integers(2, 4))
        load = np.concatenate([[0.0], np.cumsum(1.0 + np.abs(arrays(draw, (loads - 1,), 1000)))])
        some = load[[True, *(draw(st.booleans()) for _ in load[2:]), True]]
        steps = tuple(10.0 ** draw(st.integers(-12, 0)) * np.ones(size) for size in (loads, loads, some.size))
        shapes = ((loads, angles), (loads, angles), (some.size, told))
        deviation, compliance, pressure = (
            arrays(draw, shape, 2**40) * s[0] for shape, s in zip(shapes, steps, strict=True)
        )
        count = np.abs(arrays(draw, (some.size, told), 255)).astype(np.uint8)
        sides.append(tables.Side(load, deviation, compliance, some, count, pressure, steps))
    rest = arrays(draw, (angles,), 10**6)
    return tables.Tables(draw(st.sampled_from([-39.0, 40.0])), draw(st.floats(0.1, 300.0)), *sides, rest, 1e-7)


@settings(max_examples=30)
@given(made=any_tables())
def test_what_is_written_is_read_again(made):
    read = table_teeth.read(tables.write(made, Interface(), ()), "tables")
    angles = made.rest_torque.size
    loads = [size for side in (made.positive, made.negative) for size in (side.load.size, side.told_load.size)]
    assert read.numbers[:7].tolist() == [made.ratio, made.period, angles, *loads]
    assert read.largest == (made.positive.load[-1], made.negative.load[-1])
    first = 0
    for side in (made.positive, made.negative):
        for values in (side.deviation, side.compliance, side.contact_count, side.pressure):
            found = read.values[first : first + values.size].reshape(values.shape[::-1])
            np.testing.assert_allclose(found, values.T, rtol=1e-6)
            first += values.size
    assert first == read.values.size
    kept = tables.interpolation(made)  # without the file
    np.testing.assert_allclose(kept.values, read.values, rtol=1e-6)
    assert kept.numbers.size == read.numbers.size
    np.testing.assert_allclose(kept.numbers, read.numbers, rtol=1e-6, atol=1e-6 * np.abs(read.numbers).max())


@settings(max_examples=25)
@given(at=st.floats(0.0, 1.0, exclude_max=True), byte=st.integers(0, 255), cut=st.booleans(), hashed=st.booleans())
def test_a_damaged_table_is_refused_in_one_sentence_or_read_whole(drive, at, byte, cut, hashed):
    data = bytearray(tables.write(drive.tables, Interface(), ()))
    place = int(at * len(data))
    changed = bytearray(data[:place]) if cut else bytearray(data)
    if not cut:
        changed[place] = byte
    if hashed and len(changed) >= table_teeth.HEAD.size:
        struct.pack_into("<QQ", changed, 16, len(changed), table_teeth.fnv1a(bytes(changed[32:])))
    said, read = "", None
    try:
        read = table_teeth.read(bytes(changed), "drive.table")
    except ValueError as problem:
        said = str(problem)
    if read is None:
        assert said.startswith("drive.table: ")
        assert "\n" not in said
    else:
        # The hash was made to fit, or what was changed means nothing.
        assert hashed or changed == data or 12 <= place < 16
        assert np.isfinite(read.values).all()


def test_a_table_that_is_damaged_is_told_of_by_the_slave(fmu, tmp_path):
    with zipfile.ZipFile(fmu()) as archive:
        archive.extractall(tmp_path)
    table = tmp_path / "resources" / table_teeth.TABLE
    table.write_bytes(table.read_bytes()[:-1])
    with pytest.raises(ValueError, match=r"drive\.table: the table is damaged"):
        Core(tmp_path / "resources", "2.0")
