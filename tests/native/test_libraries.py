"""The libraries in the package: of which sources they are, and what they ask of a system."""

import ctypes
import os
import re
import struct
import zipfile
from importlib import metadata

import libraries
import pytest
from c_host import needs
from compensators import compensator

from cycloid_fmu import edge
from cycloid_fmu.compensation.forms.write import write_compensator
from cycloid_fmu.fmu import library
from cycloid_fmu.fmu.library import PLATFORMS, library_path
from cycloid_fmu.fmu.native import build_native
from cycloid_fmu.joint import runtime as joint

EVERY = [
    pytest.param(path, id="/".join(path.parts[-3:]))
    for path in (*libraries.PACKAGED, *libraries.JOINTS, *libraries.FRONTS)
]


@pytest.mark.parametrize("path", EVERY)
def test_the_library_that_is_shipped_comes_from_the_source(path):
    """Otherwise run `python tests/native/libraries.py`."""
    if path in libraries.JOINTS:
        digest = joint.source_hash()
    else:
        digest = libraries.front_hash() if path in libraries.FRONTS else library.source_hash()
    assert digest.encode() in path.read_bytes()


@pytest.mark.skipif(
    metadata.version("ziglang") != libraries.tested_zig(), reason="the compiler is not that of constraints.txt"
)
@pytest.mark.slow(60)
@pytest.mark.parametrize("path", EVERY)
def test_the_stated_compiler_makes_the_library_that_is_shipped_to_the_last_bit(path):
    assert libraries.compiled(path) == path.read_bytes()


@pytest.mark.parametrize("version", ["2.0", "3.0"])
def test_an_fmu_for_every_platform_needs_no_compiler(drive, tmp_path, monkeypatch, version):
    """The library is the same one for drives and compensators."""
    monkeypatch.setattr(library, "_compiled", None)
    write_compensator(compensator(), tmp_path / "joint.fmu", fmi_version=version)
    build_native(drive, tmp_path / "drive.fmu", fmi_version=version, drive_tables=drive.tables)
    with zipfile.ZipFile(tmp_path / "joint.fmu") as joint, zipfile.ZipFile(tmp_path / "drive.fmu") as native:
        names = [name for name in joint.namelist() if name.startswith("binaries/")]
        assert len(names) == {"2.0": 3, "3.0": 5}[version]
        for name in names:
            assert joint.read(name) == native.read(name.replace("CycloidCompensator", "CycloidDrive"))


@pytest.fixture
def elsewhere(tmp_path, monkeypatch):
    """A platform that the package has no library for."""
    monkeypatch.setattr(library, "LIBRARIES", tmp_path / "none")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    library._compiled.cache_clear()
    yield library.this_platform()
    library._compiled.cache_clear()


@needs("cc")
@pytest.mark.system
def test_elsewhere_the_library_is_compiled_once(elsewhere, monkeypatch):
    path = library_path(elsewhere)
    assert library.source_hash().encode() in path.read_bytes()
    version = ctypes.CDLL(str(path)).fmi2GetVersion
    version.restype = ctypes.c_char_p
    assert version() == b"2.0"
    library._compiled.cache_clear()
    monkeypatch.setenv("CC", "no-compiler")
    assert library_path(elsewhere) == path


@needs("cc")
@pytest.mark.skipif(os.name == "nt", reason="needs a path that can't be a folder")
@pytest.mark.system
def test_elsewhere_it_is_compiled_where_no_cache_can_be_written(elsewhere, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", os.devnull)
    assert library.source_hash().encode() in library_path(elsewhere).read_bytes()


def test_elsewhere_and_without_a_compiler_the_message_says_what_to_install(elsewhere, monkeypatch):
    monkeypatch.setenv("CC", "no-compiler")
    with pytest.raises(edge.InputError, match="no C compiler was found to make one; install one, such as gcc"):
        library_path(elsewhere)


def test_a_library_of_other_sources_is_not_taken(tmp_path, monkeypatch):
    """It would do what the sources beside it do not say."""
    other = next(name for name in PLATFORMS if name != library.this_platform())
    monkeypatch.setattr(library, "source_hash", lambda: "0" * 64)
    with pytest.raises(edge.InputError, match="its library is not of the present sources"):
        library_path(other)


def _mach_o_minimum(data):
    """Version of macOS that a 64-bit Mach-O library asks for (LC_BUILD_VERSION)."""
    count, at = struct.unpack_from("<I", data, 16)[0], 32
    for _ in range(count):
        kind, size = struct.unpack_from("<II", data, at)
        if kind == 0x32:
            return struct.unpack_from("<I", data, at + 12)[0] >> 16
        at += size
    raise AssertionError("no build version")


def test_libraries_ask_for_no_newer_system_than_promised():
    for path, name in (libraries.PACKAGED | libraries.JOINTS).items():
        data = path.read_bytes()
        if name.endswith("linux"):
            asked = [tuple(map(int, v.split(b"."))) for v in re.findall(rb"GLIBC_([\d.]+)\0", data)]
            assert data[:4] == b"\x7fELF"
            assert asked
            assert max(asked) <= (2, 17)
        elif name.endswith("darwin"):
            assert _mach_o_minimum(data) == 11
        else:
            assert data[:2] == b"MZ"
            asked = set(re.findall(rb"([\w-]+)\.dll\0", data.lower())) - {b"cycloiddrive", b"joint_drive"}
            assert {name for name in asked if not name.startswith(b"api-ms-win-crt-")} <= {b"kernel32"}
