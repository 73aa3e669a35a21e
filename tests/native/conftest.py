import os
from pathlib import Path
from types import SimpleNamespace

import fmpy
import platformdirs
import pytest
from c_host import BUILT, HERE, Tabled, compiled, run_host
from common import EXAMPLES

from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.fmu import library, table_cache
from cycloid_fmu.fmu import native as native_build
from cycloid_fmu.geometry.pair import read_pair
from cycloid_fmu.surfaces.surface import surface_of_pair


@pytest.fixture(scope="session")
def cache(tmp_path_factory):
    """Folder of libraries and tables that all processes of a run of the tests share: each is made once."""
    folder = tmp_path_factory.getbasetemp()
    return (folder.parent if "PYTEST_XDIST_WORKER" in os.environ else folder) / "cache"


@pytest.fixture(autouse=True, scope="module")
def _cache(cache):
    with pytest.MonkeyPatch.context() as patch:
        # What zig keeps for its targets is the user's: it takes seconds to make.
        patch.setenv("ZIG_GLOBAL_CACHE_DIR", str(platformdirs.user_cache_path("zig")))
        patch.setenv("XDG_CACHE_HOME", str(cache))
        yield


@pytest.fixture(scope="session")
def drive(cache):
    """The error-free drive of the examples: everything repeats from pin to pin, so its tables are soon made."""
    pair = read_pair(EXAMPLES / "drive-39-40.toml")
    surface = surface_of_pair(pair)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(cache))
        return Tabled(pair, surface, tables=table_cache.tables_of(DriveValue(pair, surface)))


@pytest.fixture(scope="session")
def built(drive, tmp_path_factory):
    """Native FMUs for this machine, by interface and FMI version."""
    folder, made = tmp_path_factory.mktemp("natür lich"), {}

    def one(kind="kinematic", version="2.0"):
        if (kind, version) not in made:
            path = folder / f"{kind} {version[0]}.fmu"
            native_build.build_native(
                drive,
                path,
                interface=BUILT[kind],
                fmi_version=version,
                drive_tables=drive.tables,
                platforms=[library.this_platform()],
            )
            made[kind, version] = path
        return made[kind, version]

    return one


@pytest.fixture(scope="session")
def unpacked(built, tmp_path_factory):
    """An unpacked FMU: its library, the path of its resources as its FMI version has it, guid and kind."""
    made = {}

    def one(kind="kinematic", version="2.0"):
        if (kind, version) not in made:
            path = built(kind, version)
            folder = Path(fmpy.extract(str(path), unzipdir=str(tmp_path_factory.mktemp("mit %20 lücke"))))
            description = fmpy.read_model_description(str(path))
            two = version == "2.0"
            made[kind, version] = SimpleNamespace(
                folder=folder,
                version=version,
                kind=kind,
                uri=(folder / "resources").as_uri() if two else f"{folder / 'resources'}/",
                guid=description.guid if two else description.instantiationToken,
                library=folder / "binaries" / ("linux64" if two else "x86_64-linux") / "CycloidDrive.so",
            )
        return made[kind, version]

    return one


@pytest.fixture(scope="session")
def host(tmp_path_factory):
    """The C host: `host(unpacked, "run", 100)` returns its output; with `fails` its error, or its status."""
    folder = tmp_path_factory.mktemp("host")
    programs = {
        version: compiled(
            folder / f"host{version[0]}", [HERE / "host.c"], f"-DFMI={version[0]}", "-O2", "-Wall", "-Wextra", "-Werror"
        )
        for version in ("2.0", "3.0")
    }

    def run(fmu, *words, uri=None, guid=None, fails=False, program=None, library=None, prefix=(), **environment):
        done = run_host(
            program or programs[fmu.version],
            library or fmu.library,
            uri or fmu.uri,
            guid or fmu.guid,
            fmu.kind,
            *words,
            prefix=prefix,
            **environment,
        )
        if fails is None:
            return done.returncode
        assert (done.returncode != 0) == fails, done.stderr
        return done.stderr if fails else done.stdout

    return run
