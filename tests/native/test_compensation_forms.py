"""Forms of a compensator: C99, FMUs and a look-up table, each against `step` in Python."""

import ctypes
import dataclasses
import json
import math
import shutil
import struct
import subprocess
import sys
import zlib
from pathlib import Path

import fmpy
import numpy as np
import pytest
from c_host import COMPILER, HERE, WINE, compiled, needs, needs_wine, run_host
from common import EXAMPLES
from compensators import EVERY, NONE, REACH, commands, compensator, way
from fmpy.fmi1 import FMICallException
from fmpy.validation import validate_fmu
from hypothesis import given, settings
from hypothesis import strategies as st
from libraries import windows_runtime, zig

import cycloid_fmu as cy
from cycloid_fmu import edge
from cycloid_fmu.compensation.compensator import Memory, step
from cycloid_fmu.compensation.forms import fmu as fmu_form
from cycloid_fmu.compensation.forms import numbers
from cycloid_fmu.compensation.forms.look_up import look_up
from cycloid_fmu.compensation.forms.numbers import table_body
from cycloid_fmu.compensation.forms.write import write_compensator
from cycloid_fmu.fmu import library, resource_file
from cycloid_fmu.fmu.chain import read_chain
from cycloid_fmu.fmu.resource_file import COMPENSATOR, HEAD, headed
from cycloid_fmu.fmu.run import open_fmu

STRICT = ("-Wall", "-Wextra", "-pedantic", "-Wconversion", "-Wsign-conversion", "-Wshadow", "-Werror")
OWN_ZIG = (sys.executable, "-m", "ziglang", "cc")
COMPILERS = [
    pytest.param(("gcc",), marks=needs("gcc"), id="gcc"),
    pytest.param(("clang",), marks=needs("clang"), id="clang"),
    pytest.param(OWN_ZIG, id="zig"),
]
ARM = Path("/usr/aarch64-linux-gnu")


class _Command(ctypes.Structure):
    _fields_ = [
        *((name, ctypes.c_double) for name in ("motor_angle", "motor_speed", "band", "gain")),
        ("holds", ctypes.c_int),
    ]


class InC:
    """A compensator in C, compiled and loaded."""

    def __init__(self, c, folder, compiler=COMPILER, *flags):
        source, _ = write_compensator(c, folder / "joint.c")
        library = folder / f"joint{len(list(folder.iterdir()))}.so"
        subprocess.run(
            [*compiler, "-std=c99", "-O2", *STRICT, *flags, "-shared", "-fPIC", source, "-o", library, "-lm"],
            check=True,
        )
        self._library = ctypes.CDLL(str(library))
        self._library.joint_step.restype = _Command
        self._library.joint_step.argtypes = [ctypes.c_void_p, *[ctypes.c_double] * 6]
        self._library.joint_start.argtypes = [ctypes.c_void_p, *[ctypes.c_double] * 2]

    def commands(self, rows, index, probability=1.0):
        memory = ctypes.create_string_buffer(64 * 8)
        self._library.joint_start(memory, index, probability)
        found = (self._library.joint_step(memory, *row) for row in rows.tolist())
        return np.array([[f.motor_angle, f.motor_speed, f.band, f.gain, f.holds] for f in found])


@pytest.fixture(scope="module")
def drive():
    return compensator()


@pytest.fixture(scope="module")
def in_c(drive, tmp_path_factory):
    return InC(drive, tmp_path_factory.mktemp("c"))


def test_the_ways_take_every_branch(drive):
    """Otherwise the tests below would show little: held and not, learned and not, with gains that moved."""
    found = np.vstack([commands(drive, way(drive, seed), 0.4) for seed in range(4)])
    assert 0.1 < found[:, 4].mean() < 0.95
    assert np.ptp(found[found[:, 3] > 0.0, 3]) > 0.3
    assert len(np.unique(found[:, 2])) > 500


# --- C99 ---


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**31),
    index=st.sampled_from([0.4, -17.3, 0.0, NONE, math.nan]),
    measured=st.sampled_from([0.0, 0.5, 1.0]),
    odd=st.sampled_from([0.0, 0.05, 0.5]),
    probability=st.sampled_from([0.0, 0.7, 1.0, -0.0, 3.0, math.nan]),
)
def test_c_gives_the_bits_of_python_on_any_way(drive, in_c, seed, index, measured, odd, probability):
    rows = way(drive, seed, 80, index=index, measured=measured, odd=odd)
    assert np.array_equal(in_c.commands(rows, index, probability), commands(drive, rows, index, probability))


@settings(max_examples=100, deadline=None)
@given(
    rows=st.lists(st.lists(st.floats(), min_size=6, max_size=6), min_size=1, max_size=6),
    index=st.floats(),
    probability=st.floats(),
)
def test_whatever_is_handed_over_gives_a_number_and_the_same_in_c(drive, in_c, rows, index, probability):
    found = commands(drive, np.array(rows), index, probability)
    assert np.isfinite(found).all()
    assert np.array_equal(in_c.commands(np.array(rows), index, probability), found)


@pytest.mark.parametrize("compiler", COMPILERS)
def test_every_compiler_gives_the_same_bits_without_a_warning(tmp_path, compiler):
    for number, (functions, temperatures, friction) in enumerate(EVERY if compiler == ("gcc",) else EVERY[-1:]):
        c = compensator(number, functions, temperatures, friction)
        folder = tmp_path / str(number)
        folder.mkdir()
        rows = way(c, number)
        assert np.array_equal(InC(c, folder, compiler).commands(rows, 0.4), commands(c, rows, 0.4))


@pytest.mark.parametrize("compiler", COMPILERS[:2])
def test_no_processor_that_fuses_products_and_sums_changes_the_bits(drive, tmp_path, compiler):
    """Any option of this compiler may be used, GNU's C too, which fuses by default: the source forbids that itself."""
    fused = InC(drive, tmp_path, compiler, "-std=gnu99", "-O3", "-march=native")
    rows = way(drive, 3)
    assert np.array_equal(fused.commands(rows, 0.4), commands(drive, rows, 0.4))


@pytest.mark.skipif(shutil.which("gcc") is None, reason="gcc is not installed")
def test_sums_that_may_be_reordered_are_refused(drive, tmp_path):
    write_compensator(drive, tmp_path / "joint.c")
    done = subprocess.run(["gcc", "-ffast-math", "-c", "joint.c"], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode != 0
    assert "must not be reordered" in done.stderr


def host(c, rows, index, folder, compiler, *flags, suffix=""):
    """Compile the host with a way inside."""
    source, _ = write_compensator(c, folder / "joint.c")
    bits = ",\n".join(
        "{" + ", ".join(f"{NONE if abs(v) == math.inf or v != v else v!r}" for v in row) + "}" for row in rows.tolist()
    )
    (folder / "sequence.h").write_text(
        f"#define ROWS {len(rows)}\n#define INDEX {index!r}\n#define PROBABILITY 1.0\n"
        f"static const double SEQUENCE[ROWS][6] = {{\n{bits}\n}};\n"
    )
    program = folder / f"host{suffix}"
    subprocess.run(
        [
            *compiler,
            "-std=c99",
            "-O2",
            *map(str, (HERE / "compensation_host.c", source)),
            "-I",
            str(folder),
            "-o",
            str(program),
            *flags,
        ],
        check=True,
    )
    return program


def printed(words, **environment):
    done = subprocess.run([*map(str, words)], capture_output=True, text=True, check=True, env=environment or None)
    rows = [line.split() for line in done.stdout.splitlines()]
    return np.array([[*(np.uint64(int(w, 16)).view(np.float64) for w in row[:4]), float(row[4])] for row in rows])


@pytest.mark.skipif(
    shutil.which("qemu-aarch64") is None or not ARM.is_dir(), reason="qemu-user and libc6-arm64-cross are not installed"
)
def test_an_arm_processor_gives_the_same_bits(drive, tmp_path):
    rows = way(drive, 11, 1000)
    program = host(drive, rows, 0.4, tmp_path, zig("aarch64-linux"), "-lm")
    assert np.array_equal(printed(["qemu-aarch64", "-L", ARM, program]), commands(drive, rows, 0.4))


@needs_wine
@pytest.mark.slow(10)
def test_windows_gives_the_same_bits(drive, tmp_path):
    rows = way(drive, 11, 1000)
    runtime = ("-Wl,--entry=start", HERE / "windows_start.c", *windows_runtime("runtime"))
    program = host(drive, rows, 0.4, tmp_path, zig("x86_64-windows"), *map(str, runtime), suffix=".exe")
    found = printed([WINE, program], WINEPREFIX=str(tmp_path / "wine"), WINEDEBUG="-all")
    assert np.array_equal(found, commands(drive, rows, 0.4))


@pytest.mark.parametrize("name", ["joint.st", "joint.txt"])
def test_a_form_that_there_is_not_is_refused_with_those_that_there_are(drive, tmp_path, name):
    with pytest.raises(edge.InputError, match=r"joint\.\w+: the name must end in \.c or \.h or \.csv or \.fmu\.$"):
        write_compensator(drive, tmp_path / name)


@pytest.mark.parametrize("name", ["1st.c", "joint-.c", "a__b.c", "while.c", "gelenk_ü.c"])
def test_a_name_that_no_language_allows_is_refused(drive, tmp_path, name):
    with pytest.raises(edge.InputError, match="must begin with a letter"):
        write_compensator(drive, tmp_path / name)
    assert not list(tmp_path.iterdir())


# --- look-up ---


def test_the_look_up_table_is_the_command_without_memory(tmp_path):
    """Without friction, nothing learned: the motor's angle minus that of an ideal drive, anywhere between the nodes."""
    c = compensator(5, friction=False)
    c.inverse.__dict__["residual"] = 1e-5
    (path,) = write_compensator(c, tmp_path / "joint.csv", temperature=300.0)
    torque, crank, correction = np.loadtxt(path, delimiter=",", skiprows=5).T
    torques = np.unique(torque)
    table = correction.reshape(torques.size, -1)
    cranks = crank[: table.shape[1]]
    random = np.random.default_rng(3)
    for load, angle in zip(random.uniform(-REACH, REACH, 50), random.uniform(-5.0, 5.0, 50), strict=True):
        at = (c.crank_ratio * angle + 0.4) % c.inverse.period
        over = [np.interp(at, cranks, row) for row in table]
        motor = c.ratio * angle + np.interp(load, torques, over)
        exact = step(c, Memory(0.4), angle, 0.0, load, 300.0).motor_angle
        assert abs(motor - exact) / abs(c.ratio) < look_up(c, 300.0).residual - c.inverse.residual + 1e-9


# --- FMUs ---


@pytest.fixture(scope="module")
def fmus(drive, tmp_path_factory):
    """FMUs for this machine, by version."""
    folder = tmp_path_factory.mktemp("fmus")
    for version in ("2.0", "3.0"):
        write_compensator(drive, folder / f"{version[0]}.fmu", fmi_version=version, platforms=[library.this_platform()])
    return {version: folder / f"{version[0]}.fmu" for version in ("2.0", "3.0")}


INPUTS = (
    "desired_angle",
    "desired_speed",
    "load_torque",
    "temperature",
    "motor_angle_measured",
    "output_angle_measured",
)
OUTPUTS = ("motor_angle", "motor_speed", "band", "gain")


def shown(row):
    """A row as inputs of an FMU: numbers, and whether there is a measurement."""
    measured = bool(np.isfinite(row[4:]).all() and (np.abs(row[4:]) < 1e12).all())
    return [float(v) for v in row[:4]] + ([float(v) for v in row[4:]] if measured else [0.0, 0.0]), measured


def by_fmpy(path, rows, index):
    with open_fmu(path, INPUTS, OUTPUTS) as fmu:
        fmu.initialize({"index": index, "index_probability": 1.0})
        write, read, found = fmu.writer(INPUTS), fmu.reader(OUTPUTS), []
        for i, row in enumerate(rows):
            numbers, measured = shown(row)
            write(numbers)
            fmu.set({"output_measured": measured})
            fmu.step(1e-3 * i, 1e-3)
            found.append([*read(), *fmu.slave.getBoolean([fmu.variables["holds"].valueReference])])
    return found


def by_fmuloader(path, rows, index):
    from fmuloader.fmi3 import Fmi3Slave

    description = fmpy.read_model_description(str(path))
    host = Fmi3Slave(str(path), model_identifier=description.coSimulation.modelIdentifier)
    host.instantiate_co_simulation("joint", instantiation_token=description.instantiationToken)
    host.enter_initialization_mode(start_time=0.0)
    host.set_float64([7, 8], [index, 1.0])
    host.exit_initialization_mode()
    found = []
    for i, row in enumerate(rows):
        numbers, measured = shown(row)
        host.set_float64([0, 1, 2, 3, 4, 5], numbers)
        host.set_boolean([6], [measured])
        host.do_step(1e-3 * i, 1e-3)
        found.append([*host.get_float64([9, 10, 11, 12]), *host.get_boolean([13])])
    host.terminate()
    host.free_instance()
    return found


def by_libcosimpy(path, rows, index):
    from libcosimpy.CosimExecution import CosimExecution
    from libcosimpy.CosimManipulator import CosimManipulator
    from libcosimpy.CosimObserver import CosimObserver
    from libcosimpy.CosimSlave import CosimLocalSlave

    execution = CosimExecution.from_step_size(step_size=1_000_000)
    slave = execution.add_local_slave(CosimLocalSlave(fmu_path=str(path), instance_name="joint"))
    given, seen = CosimManipulator.create_override(), CosimObserver.create_last_value()
    execution.add_manipulator(manipulator=given)
    execution.add_observer(observer=seen)
    execution.real_initial_value(slave, 7, index)
    execution.real_initial_value(slave, 8, 1.0)
    found = []
    for row in rows:
        numbers, measured = shown(row)
        given.slave_real_values(slave, [0, 1, 2, 3, 4, 5], numbers)
        given.slave_boolean_values(slave, [6], [measured])
        execution.step()
        found.append([*seen.last_real_values(slave, [9, 10, 11, 12]), *seen.last_boolean_values(slave, [13])])
    return found


@pytest.mark.parametrize(
    ("importer", "version"), [(by_fmpy, "2.0"), (by_fmpy, "3.0"), (by_fmuloader, "3.0"), (by_libcosimpy, "2.0")]
)
def test_importers_get_what_python_gives(drive, fmus, importer, version):
    rows = way(drive, 21, 200, odd=0.0)
    found = np.array(importer(fmus[version], rows, 0.4), dtype=float)
    assert np.array_equal(found, commands(drive, rows, 0.4))


@pytest.mark.parametrize("version", ["2.0", "3.0"])
def test_validation_finds_nothing(fmus, version):
    assert validate_fmu(str(fmus[version])) == []


@pytest.mark.parametrize("version", ["2.0", "3.0"])
def test_states_bring_back_what_was_and_damaged_ones_are_refused(drive, fmus, version):
    rows = way(drive, 22, 60, odd=0.0)
    expected = commands(drive, rows, 0.0, 0.0)[:, 0]
    with open_fmu(fmus[version], INPUTS, OUTPUTS) as fmu:
        write, read, slave = fmu.writer(INPUTS), fmu.reader(["motor_angle"]), fmu.slave
        get, put, pack, unpack, free = (
            getattr(slave, f"{name}FMUState") for name in ("get", "set", "serialize", "deserialize", "free")
        )
        fmu.initialize()

        def go(first, last):
            found = []
            for i in range(first, last):
                numbers, measured = shown(rows[i])
                write(numbers)
                fmu.set({"output_measured": measured})
                fmu.step(1e-3 * i, 1e-3)
                found += read()
            return found

        assert np.array_equal(go(0, 30), expected[:30])
        state = get()
        data = bytes(pack(state))
        assert np.array_equal(go(30, 60), expected[30:])
        put(state)
        assert np.array_equal(go(30, 60), expected[30:])
        again = unpack(data)
        put(again)
        assert np.array_equal(go(30, 60), expected[30:])
        random = np.random.default_rng(1)
        for _ in range(40):
            damaged = bytearray(data)
            damaged[random.integers(len(data))] ^= 1 << random.integers(8)
            with pytest.raises(FMICallException):
                unpack(bytes(damaged))
        with pytest.raises(FMICallException):
            unpack(data[:-8])
        for one in (state, again):
            free(one)


def sealed(data):
    """A state with the checksum (CRC-32) that belongs to its contents."""
    return bytes(data[:24]) + zlib.crc32(data[32:]).to_bytes(8, "little") + bytes(data[32:])


def test_a_state_with_a_right_checksum_and_wrong_contents_stops_no_host(drive, fmus):
    random, rows = np.random.default_rng(2), way(drive, 23, 5)
    with open_fmu(fmus["2.0"], INPUTS, OUTPUTS) as fmu:
        fmu.initialize()
        state = fmu.slave.getFMUState()
        data = bytes(fmu.slave.serializeFMUState(state))
        assert sealed(data) == data
        for _ in range(100):
            wrong = bytearray(data)
            for place in random.integers(32, len(data), 4):
                wrong[place] = random.integers(256)
            one = fmu.slave.deserializeFMUState(sealed(wrong))
            fmu.slave.setFMUState(one)
            for row in rows:
                fmu.writer(INPUTS)(shown(row)[0])
                fmu.set({"output_measured": True})
                fmu.step(0.0, 1e-3)
            fmu.slave.freeFMUState(one)
        fmu.slave.setFMUState(state)
        fmu.slave.freeFMUState(state)


def test_a_state_of_another_compensator_is_refused(fmus):
    with open_fmu(fmus["2.0"]) as one, open_fmu(fmus["3.0"]) as other:
        one.initialize()
        other.initialize()
        state = one.slave.getFMUState()
        changed = bytearray(one.slave.serializeFMUState(state))
        changed[20] ^= 1  # of whose it is
        for fmu in (one, other):
            with pytest.raises(FMICallException):
                fmu.slave.deserializeFMUState(bytes(changed))
        one.slave.freeFMUState(state)


def test_what_is_no_input_is_refused_and_the_index_is_fixed(fmus):
    with open_fmu(fmus["2.0"], INPUTS, OUTPUTS) as fmu:
        fmu.initialize({"index": 0.3, "desired_angle": 0.1})
        for name in ("motor_angle", "index", "index_probability"):
            with pytest.raises(FMICallException):
                fmu.set({name: 1.0})
        before = fmu.reader(OUTPUTS)()
        for name in INPUTS:
            for value in (math.nan, math.inf, -math.inf):
                with pytest.raises(FMICallException):
                    fmu.set({name: value})
        assert fmu.reader(OUTPUTS)() == before
        with pytest.raises(edge.InputError, match="must be finite"):
            fmu.step(0.0, math.nan)


def test_outputs_are_there_before_the_first_step_and_without_an_index(drive, fmus):
    for probability in (1.0, 0.6, 0.0):
        stated = {"index": 0.3, "index_probability": probability} if probability else {}
        with open_fmu(fmus["3.0"], INPUTS, OUTPUTS) as fmu:
            fmu.initialize({"desired_angle": 0.1, "load_torque": 20.0, **stated})
            memory = Memory(0.3, probability) if stated else Memory(math.nan)
            command = step(drive, memory, 0.1, 0.0, 20.0, 293.15)
            assert fmu.reader(OUTPUTS)() == list(command[:4])


TOKEN = "{token}"


def table_with_measurements(c, token=TOKEN):
    """A file of tables whose FMU takes measurements from the start, so that it learns."""
    listed = [
        dataclasses.replace(v, start=1.0) if v.name == "output_measured" else v for v in fmu_form.variables("2.0")
    ]
    return resource_file.sealed(table_body(c, listed), token, COMPENSATOR)


@pytest.fixture(scope="module")
def run(fmus, tmp_path_factory):
    """The C host of native FMUs on the compensator's library: `run(folder of resources, "run", 100)`."""
    folder = tmp_path_factory.mktemp("host")
    program = compiled(folder / "host", [HERE / "host.c"], "-DFMI=2", "-O2")

    def run(resources, *words, program=program, library=library.library_path(library.this_platform()), **environment):
        return run_host(program, library, resources.as_uri(), TOKEN, "compensator", *words, **environment)

    return run


def hostile(data, seed, count):
    """Files of tables with a right checksum and wrong contents: of counts, numbers, lengths and texts."""
    random = np.random.default_rng(seed)
    last = HEAD.size + 15 * 60 + 100  # where the variables and the counts are
    for i in range(count):
        changed = bytearray(data[HEAD.size :])
        for place in random.integers(0, (last if i % 2 else len(data)) - HEAD.size, 3):
            changed[place] = random.integers(256)
        yield headed(bytes(changed), COMPENSATOR)


def test_a_damaged_file_of_tables_is_refused_in_one_sentence(drive, run, tmp_path):
    data, random = table_with_measurements(drive), np.random.default_rng(4)
    (tmp_path / COMPENSATOR.file).write_bytes(data)
    assert run(tmp_path, "run", 5).returncode == 0
    places = random.integers(len(data), size=40)
    damaged = [data[:place] for place in (0, 7, 31, 32, *places[:20])]
    damaged += [
        data[:place] + bytes([data[place] ^ 1 << int(random.integers(8))]) + data[place + 1 :] for place in places
    ]
    for content in (*damaged, data + b"1234"):
        (tmp_path / COMPENSATOR.file).write_bytes(content)
        done = run(tmp_path, "open")
        assert done.returncode == 1
        (said,) = done.stderr.splitlines()[:-1]
        assert "compensator.table: " in said
        assert said.endswith(".")
    (tmp_path / COMPENSATOR.file).write_bytes(table_with_measurements(drive, "{other}"))
    assert "belong to two FMUs" in run(tmp_path, "open").stderr


def test_more_functions_than_an_fmu_has_room_for_are_refused(tmp_path):
    write_compensator(compensator(functions=64), tmp_path / "joint.fmu", platforms=["x86_64-windows"])
    with pytest.raises(edge.InputError, match="65 functions of the crank angle, and an FMU has room for 64"):
        write_compensator(compensator(functions=65), tmp_path / "more.fmu")
    assert not (tmp_path / "more.fmu").exists()


def test_sizes_that_do_not_fit_are_refused(drive, run, tmp_path):
    """Each count is one more or less, or far too large: the numbers behind it would not be where they are sought."""
    data = table_with_measurements(drive)
    body = table_body(drive, fmu_form.variables("2.0"))
    counts = struct.pack("<5I", *(numbers.counts(drive)[name] for name in numbers.SIZES))
    at = HEAD.size + body.index(counts)
    for k in range(5):
        (count,) = struct.unpack_from("<I", data, at + 4 * k)
        for wrong in (count - 1, count + 1, 0, 65535, 65536, 2**31, 2**32 - 1):
            changed = bytearray(data)
            struct.pack_into("<I", changed, at + 4 * k, wrong)
            (tmp_path / COMPENSATOR.file).write_bytes(headed(bytes(changed[HEAD.size :]), COMPENSATOR))
            done = run(tmp_path, "open")
            assert done.returncode == 1
            assert "the table is damaged" in done.stderr, (k, wrong)


def test_wrong_contents_with_a_right_checksum_stop_no_host(drive, run, tmp_path):
    for content in hostile(table_with_measurements(drive), 5, 60):
        (tmp_path / COMPENSATOR.file).write_bytes(content)
        assert run(tmp_path, "run", 5).returncode in (0, 1)


@pytest.mark.slow(60)
@pytest.mark.skipif(shutil.which("gcc") is None, reason="gcc is not installed")
def test_the_library_is_clean_under_the_address_and_undefined_behaviour_sanitizers(drive, run, fmus, tmp_path):
    flags = ("-O1", "-fsanitize=address,undefined", "-fno-sanitize-recover=all", "-fno-omit-frame-pointer")
    fmpy.extract(str(fmus["2.0"]), unzipdir=str(tmp_path / "fmu"))
    sources = [tmp_path / "fmu" / "sources" / name for name in library.SOURCES]
    clean = {
        "library": compiled(tmp_path / "compensator.so", sources, *flags, "-shared", "-fPIC"),
        "program": compiled(tmp_path / "host", [HERE / "host.c"], "-DFMI=2", *flags),
        "ASAN_OPTIONS": "exitcode=99",
        "UBSAN_OPTIONS": "exitcode=99",
    }
    for number, (functions, temperatures, friction) in enumerate(EVERY):
        data = table_with_measurements(compensator(number, functions, temperatures, friction))
        (tmp_path / COMPENSATOR.file).write_bytes(data)
        saved = tmp_path / "state"
        for words in (("run", 500), ("random", 5000), ("rollback", 50), ("open",), ("save", saved), ("load", saved)):
            done = run(tmp_path, *words, **clean)
            assert done.returncode == 0, done.stderr
    for content in hostile(table_with_measurements(drive), 6, 300):
        (tmp_path / COMPENSATOR.file).write_bytes(content)
        done = run(tmp_path, "random", 20, **clean)
        assert done.returncode in (0, 1), done.stderr


@pytest.mark.slow(2)
@pytest.mark.parametrize("compiler", COMPILERS)
def test_sources_in_the_fmu_compile_without_a_warning(fmus, tmp_path, compiler):
    for version, path in fmus.items():
        fmpy.extract(str(path), unzipdir=str(tmp_path / version))
        for source in library.SOURCES if version == "2.0" else ():
            subprocess.run(
                [*compiler, "-std=c99", *STRICT, "-c", source, "-o", tmp_path / "made.o"],
                cwd=tmp_path / version / "sources",
                check=True,
            )


# --- the command ---


@pytest.fixture
def fit(tmp_path):
    """The part of an identification that the command uses."""
    path = tmp_path / "fit.json"
    bench = {"chain_compliance": 2e-6, "friction_torque": 3.0, "output_angle_offset": 1e-4}
    path.write_text(json.dumps({"format": "cycloid-identification/1", "bench": bench}))
    return path


@pytest.mark.slow(1)
def test_the_command_writes_what_the_library_does(command, tmp_path, fit):
    words = (EXAMPLES / "drive-39-40.toml", "--residual", "3 arcsec", "--fit", fit)
    done = command("cycloid-fmu", "compensate", *words, "-o", "joint.c", "--plot", "joint.png")
    assert done.returncode == 0, done.stderr
    made = cy.read_drive(EXAMPLES / "drive-39-40.toml").compensator(
        residual="3 arcsec", friction=cy.Friction(coulomb=3.0), series_compliance=2e-6
    )
    assert f"tables of {made.size} bytes" in done.stdout
    (tmp_path / "own").mkdir()
    write_compensator(made, tmp_path / "own" / "joint.c")
    for name in ("joint.c", "joint.h"):
        assert (tmp_path / name).read_bytes() == (tmp_path / "own" / name).read_bytes()
    assert (tmp_path / "joint.png").stat().st_size > 10_000


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["-o", "1st.c"], '--output = "1st.c": its name is also that of its content: it must begin with a letter'),
        (["-o", "joint.m"], "the name must end in"),
        (["-o", "joint.c", "--temperatures", "20 degC"], "give two values separated by a comma"),
        (["-o", "joint.c", "--temperatures", "20 degC, 5 mm"], "use one such as degC"),
        (
            ["-o", "joint.c", "--fit", "fit.json", "--stiffness", "1 N*m/rad"],
            "--stiffness: --fit determines the series compliance too",
        ),
        (["-o", "joint.c", "--fit", "{drive}"], "(cycloid-identification/1) is needed here"),
        (["-o", "joint.c", "--fmi", "3.0"], "--fmi: this option is for FMUs"),
        (["-o", "joint.fmu", "--platform", "m68k-amiga"], '--platform = "m68k-amiga": this is none of'),
    ],
)
def test_what_the_command_can_not_use_is_refused_in_one_sentence(command, tmp_path, fit, words, said):
    drive = str(EXAMPLES / "drive-39-40.toml")
    done = command("cycloid-fmu", "compensate", drive, *(w.replace("{drive}", drive) for w in words))
    assert done.returncode == edge.BAD_INPUT
    assert said in done.stderr
    assert "Traceback" not in done.stderr
    assert [p.name for p in tmp_path.iterdir()] == ["fit.json"]


def test_a_fit_without_a_bench_is_refused(tmp_path):
    path = tmp_path / "fit.json"
    path.write_text('{"format": "cycloid-identification/1", "bench": {"chain_compliance": 1e-6}}')
    with pytest.raises(edge.InputError, match="bench has no friction_torque"):
        read_chain(path)
