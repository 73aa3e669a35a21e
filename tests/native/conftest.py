from pathlib import Path
from types import SimpleNamespace

import fmpy
import pytest
from c_host import COMPILER, HERE, INTERFACES, compiled, run_host
from common import EXAMPLES

from cycloid_fmu.fmu import native_build, tables
from cycloid_fmu.pair import read_pair
from cycloid_fmu.surface import surface_of_pair


@pytest.fixture(scope="session")
def drive():
    """The error-free drive of the examples: everything repeats from pin to pin, so its tables are soon made."""
    pair = read_pair(EXAMPLES / "drive-39-40.toml")
    surface = surface_of_pair(pair)
    return SimpleNamespace(pair=pair, surface=surface, tables=tables.compute(pair, surface))


@pytest.fixture(scope="session")
def built(drive, tmp_path_factory):
    """Native FMUs for this machine, by interface and FMI version, compiled with the system's compiler."""
    folder, made = tmp_path_factory.mktemp("natür lich"), {}

    def one(kind="kinematic", version="2.0"):
        if (kind, version) not in made:
            path = folder / f"{kind} {version[0]}.fmu"
            with pytest.MonkeyPatch.context() as patch:
                patch.setenv("CC", COMPILER[0] if len(COMPILER) == 1 else "")
                patch.setenv("XDG_CACHE_HOME", str(folder))
                native_build.build_native(
                    drive.pair, drive.surface, path, INTERFACES[kind], version, made=drive.tables,
                    platforms=[native_build.this_platform()],
                )  # fmt: skip
            made[kind, version] = path
        return made[kind, version]

    return one


@pytest.fixture(scope="session")
def unpacked(built, tmp_path_factory):
    """An unpacked FMI 2.0 FMU: its library, the URI of its resources and its guid."""
    made = {}

    def one(kind="kinematic"):
        if kind not in made:
            path = built(kind)
            folder = Path(fmpy.extract(str(path), unzipdir=str(tmp_path_factory.mktemp("mit %20 lücke"))))
            guid = fmpy.read_model_description(str(path)).guid
            made[kind] = SimpleNamespace(
                folder=folder, uri=(folder / "resources").as_uri(), guid=guid,
                library=folder / "binaries" / "linux64" / "CycloidDrive.so",
            )  # fmt: skip
        return made[kind]

    return one


@pytest.fixture(scope="session")
def host(tmp_path_factory):
    """The C host: `host(unpacked, "run", 100)` returns what it prints; with `fails` why it failed, or its status."""
    program = compiled(
        tmp_path_factory.mktemp("host") / "host", [HERE / "host.c"], "-O2", "-Wall", "-Wextra", "-Werror"
    )

    def run(fmu, *words, uri=None, guid=None, fails=False, program=program, library=None, prefix=(), **environment):
        done = run_host(
            program, library or fmu.library, uri or fmu.uri, guid or fmu.guid, *words, prefix=prefix, **environment
        )
        if fails is None:
            return done.returncode
        assert (done.returncode != 0) == fails, done.stderr
        return done.stderr if fails else done.stdout

    return run
