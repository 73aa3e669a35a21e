"""The library before pythonfmu's in an FMU of FMI 2.0: calls go on as they are but for the resources' path."""

import ctypes
import os
import re
import subprocess
import tempfile
import threading
from importlib import metadata
from pathlib import Path
from types import SimpleNamespace

import libraries
import pytest
from c_host import HERE, WINE, compiled, needs_wine
from libraries import FRONT, windows_runtime, zig

from cycloid_fmu.fmu.library import headers

LOGGER = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_char_p, ctypes.c_int, ctypes.c_char_p, ctypes.c_char_p)


def signatures():
    """Kinds of arguments ("i" for integers and pointers, "d" for reals) of FMI 2.0's functions, by name."""
    text = (headers() / "fmi2FunctionTypes.h").read_text()
    found = {}
    for name, arguments in re.findall(r"typedef\s+fmi2Status\s+(fmi2\w+)TYPE\s*\(([^)]*)\);", text):
        kinds = [re.fullmatch(r"\s*fmi2Real\s+\w+\s*", word) for word in arguments.split(",")]
        found[name] = "".join("i" if kind is None else "d" for kind in kinds)
    return found


@pytest.fixture(scope="session")
def behind(tmp_path_factory):
    calls = " ".join(f"CALL({name})" for name in signatures())
    path = tmp_path_factory.mktemp("behind") / "pythonfmu-export.so"
    return compiled(path, [HERE / "front_behind.c"], f"-DCALLS={calls}", "-shared", "-fPIC")


@pytest.fixture(scope="session", params=["shipped", "compiled here"])
def front(request, tmp_path_factory):
    shipped = FRONT / "linux64/CycloidDrive.so"
    if request.param == "shipped":
        return shipped
    path = tmp_path_factory.mktemp("front") / "CycloidDrive.so"
    path.write_bytes(libraries.compiled(shipped))
    return path


@pytest.fixture
def placed(front, behind, tmp_path):
    """Both libraries side by side in a folder, as the FMU has them."""

    def place(folder="one", library=behind):
        beside = tmp_path / folder
        beside.mkdir()
        (beside / "CycloidDrive.so").write_bytes(front.read_bytes())
        if library is not None:
            (beside / "pythonfmu-export.so").write_bytes(library.read_bytes())
        return beside

    return place


def opened(path):
    library = ctypes.CDLL(str(path))
    library.fmi2Instantiate.restype = ctypes.c_void_p
    library.fmi2SetDebugLogging.argtypes = [ctypes.c_void_p, ctypes.c_int, ctypes.c_size_t, ctypes.c_void_p]
    library.fmi2FreeInstance.argtypes = [ctypes.c_void_p]
    library.fmi2FreeInstance.restype = None
    return library


def instantiate(library, location, guid=b"", functions=None):
    return library.fmi2Instantiate(b"one", 1, guid, location, functions, 0, 0)


def seen(folder):
    """The calls that reached the library behind."""
    library = ctypes.CDLL(str(folder / "pythonfmu-export.so"))
    return SimpleNamespace(
        last=(ctypes.c_char * 64).in_dll(library, "last").value.decode(),
        location=(ctypes.c_char * 4096).in_dll(library, "location").value.decode(),
        integers=list((ctypes.c_size_t * 7).in_dll(library, "integers")),
        reals=list((ctypes.c_double * 3).in_dll(library, "reals")),
    )


def is_loaded(path):
    return str(path) in Path("/proc/self/maps").read_text()


def test_a_fatal_status_behind_is_an_error_before_but_of_a_reset(placed):
    folder = placed()
    library = opened(folder / "CycloidDrive.so")
    component = instantiate(library, b"/somewhere/resources")
    answer = ctypes.c_int.in_dll(ctypes.CDLL(str(folder / "pythonfmu-export.so")), "answer")
    for behind, before in ((0, 0), (1, 1), (3, 3), (4, 3)):
        answer.value = behind
        for name, kinds in signatures().items():
            if hasattr(library, name) and name != "fmi2SetDebugLogging":
                library[name].argtypes = [ctypes.c_size_t if kind == "i" else ctypes.c_double for kind in kinds]
                expected = behind if name == "fmi2Reset" else before
                assert library[name](*([0] * len(kinds))) == expected, name
    library.fmi2FreeInstance(component)


def test_it_has_the_functions_that_pythonfmu_has(front):
    library = metadata.distribution("pythonfmu").locate_file(
        "pythonfmu/resources/binaries/linux64/libpythonfmu-export.so"
    )
    theirs, ours = ctypes.CDLL(str(library)), ctypes.CDLL(str(front))
    header = (headers() / "fmi2Functions.h").read_text()
    names = set(re.findall(r"TYPE +(fmi2\w+);", header))
    assert {n for n in names if hasattr(ours, n)} == {n for n in names if hasattr(theirs, n)}
    for name in ("fmi2GetVersion", "fmi2GetTypesPlatform"):
        told = [getattr(library, name) for library in (ours, theirs)]
        for function in told:
            function.restype = ctypes.c_char_p
        assert told[0]() == told[1]()


def test_every_call_goes_on_as_it_is(placed):
    folder = placed()
    library = opened(folder / "CycloidDrive.so")
    component = instantiate(library, b"/somewhere/resources")
    assert seen(folder).integers[1] == 1
    assert seen(folder).integers[5:] == [0, 1]  # logging is on behind, for any request of the host
    assert library.fmi2SetDebugLogging(component, 0, 0, None) == 0
    assert seen(folder).last == "fmi2Instantiate"
    called = 0
    for name, kinds in signatures().items():
        # Functions of Model Exchange are not there.
        if not hasattr(library, name) or name == "fmi2SetDebugLogging":
            continue
        called += 1
        function, values = library[name], [3 + i if kind == "i" else 0.5 + i for i, kind in enumerate(kinds)]
        function.argtypes = [ctypes.c_size_t if kind == "i" else ctypes.c_double for kind in kinds]
        # A step that is discarded behind is an error before.
        assert function(*values) == (3 if name == "fmi2DoStep" else 2)
        found = seen(folder)
        assert found.last == name
        whole, real = ([v for v, k in zip(values, kinds, strict=True) if k == kind] for kind in "id")
        # Above the 32 bits of an integer a register may hold anything.
        assert [v & 0xFFFFFFFF for v in found.integers[: len(whole)]] == whole
        assert found.reals[: len(real)] == real
    assert called == 29
    library.fmi2FreeInstance(component)
    assert (seen(folder).last, seen(folder).integers[0]) == ("fmi2FreeInstance", component)


@pytest.mark.parametrize(
    ("location", "path"),
    [
        ("file:///home/M%C3%BCller/a%20b/resources", "/home/Müller/a b/resources"),
        ("file://localhost/tmp/100%25/resources", "/tmp/100%/resources"),
        ("file:/tmp/resources", "/tmp/resources"),
        ("file:///tmp/歯車/resources", "/tmp/歯車/resources"),
        ("/home/Müller/100%25", "/home/Müller/100%25"),
    ],
)
def test_the_location_becomes_a_path(placed, location, path):
    folder = placed()
    library = opened(folder / "CycloidDrive.so")
    component = instantiate(library, location.encode())
    assert seen(folder).location == path
    library.fmi2FreeInstance(component)


def test_each_fmu_has_its_own_library_behind_also_from_a_relative_path(placed, tmp_path, monkeypatch):
    folders = [placed(name) for name in ("one", "Gerät 歯車")]
    monkeypatch.chdir(tmp_path.parent)
    libraries = [opened(os.path.join(tmp_path.name, folder.name, "CycloidDrive.so")) for folder in folders]
    monkeypatch.chdir("/")
    components = [instantiate(library, f"/{i}".encode()) for i, library in enumerate(libraries)]
    assert [seen(folder).location for folder in folders] == ["/0", "/1"]
    for library, component in zip(libraries, components, strict=True):
        library.fmi2FreeInstance(component)


def test_the_library_behind_is_let_go_with_the_last_instance(placed):
    folder = placed()
    library, behind = opened(folder / "CycloidDrive.so"), folder / "pythonfmu-export.so"
    assert instantiate(library, b"/r", b"foreign") is None
    assert not is_loaded(behind)
    components = [instantiate(library, b"/r") for _ in range(2)]
    library.fmi2FreeInstance(components[0])
    library.fmi2FreeInstance(None)
    assert is_loaded(behind)
    library.fmi2FreeInstance(components[1])
    assert not is_loaded(behind)

    def many():
        for _ in range(300):
            library.fmi2FreeInstance(instantiate(library, b"/r"))

    threads = [threading.Thread(target=many) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not is_loaded(behind)


def test_what_stands_in_the_way_is_said(placed, tmp_path):
    told = []
    logger = LOGGER(lambda environment, name, status, category, message: told.append((status, message.decode())))
    functions = (ctypes.c_void_p * 5)(ctypes.cast(logger, ctypes.c_void_p))
    other = compiled(tmp_path / "other.so", [HERE.parents[1] / "cycloid_fmu/fmu/clockwork/uri.c"], "-shared", "-fPIC")
    for folder, library, location, said in (
        # The message is a format: a host in C would look for an argument behind each single %.
        ("100% none", None, b"/r", "100%% none/pythonfmu-export.so: cannot open shared object file"),
        ("other", other, b"/r", "it has no fmi2SetupExperiment"),
        ("location", other, b"https://host/resources", "the resources' location is neither a path nor a file URI"),
    ):
        front = opened(placed(folder, library) / "CycloidDrive.so")
        assert instantiate(front, location, functions=functions) is None
        status, message = told.pop()
        assert status == 3
        assert said in message
        assert not told
    assert instantiate(front, None, functions=functions) is None
    assert told


@pytest.fixture
def alone():
    """A folder without neighbours: Wine looks for a short name among all that a folder has."""
    with tempfile.TemporaryDirectory(prefix="front") as folder:
        yield Path(folder)


@pytest.mark.slow(1)
@needs_wine
@pytest.mark.parametrize("made", ["shipped", "compiled here"])
def test_the_windows_library_hands_on_a_path_of_ascii(alone, made):
    runtime = windows_runtime("runtime")
    folder = alone / "Gerät 歯車"
    (folder / "resources").mkdir(parents=True)
    calls = "".join(f"CALL({name})" for name in signatures())
    behind = compiled(
        alone / "pythonfmu-export.exe",
        [HERE / "front_behind.c"],
        f"-DCALLS={calls}",
        "-O2",
        "-shared",
        "-Wl,--no-entry",
        *runtime,
        compiler=zig("x86_64-windows"),
    )
    (folder / "pythonfmu-export.dll").write_bytes(behind.read_bytes())
    shipped = FRONT / "win64/CycloidDrive.dll"
    library_bytes = shipped.read_bytes() if made == "shipped" else libraries.compiled(shipped)
    (folder / "CycloidDrive.dll").write_bytes(library_bytes)
    host = compiled(
        alone / "host.exe",
        [HERE / "front_host.c", HERE / "windows_start.c"],
        "-O2",
        "-Wl,--entry=start",
        *runtime,
        compiler=zig("x86_64-windows"),
    )
    environment = {**os.environ, "WINEPREFIX": str(alone / "wine"), "WINEDEBUG": "-all"}
    for resources in (folder / "resources", alone):
        uri = resources.as_uri().replace("file:///", "file:///Z:/")
        run = subprocess.run([WINE, host, uri], cwd=folder, env=environment, capture_output=True, check=True)
        location, status, end = run.stdout.decode().split("\n")[:3]
        assert (status, end) == ("discarded", "let go")
        assert location.isascii()
        if resources == alone:
            assert location == f"Z:{alone}"
        else:  # it ends with the short name of the folder
            assert re.fullmatch(r"[\x21-\x7d]+~[^/]+", Path(location).parent.name)
