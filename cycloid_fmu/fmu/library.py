"""The shared library of native FMUs: the drive in time, the compensator, and FMI around them.

It depends on no drive. The package contains it for five platforms, compiled in advance; on others it is compiled once.
"""

from __future__ import annotations

import atexit
import dataclasses
import functools
import hashlib
import os
import platform
import shutil
import subprocess
import tempfile
from pathlib import Path

from cycloid_fmu import edge
from cycloid_fmu.edge import ArgumentError
from cycloid_fmu.fmu.table_file import constants_header

_HERE = Path(__file__).parent
SOURCE_FOLDERS = (_HERE / "clockwork", _HERE.parent / "compensation" / "forms" / "sources")
SOURCES = tuple(path.name for folder in SOURCE_FOLDERS for path in sorted(folder.glob("*.c")))
FLAGS = ("-std=c99", "-O2", "-fPIC", "-shared", "-fvisibility=hidden", "-ffp-contract=off", "-s")
LIBRARIES = _HERE / "libraries"
LICENCE = LIBRARIES / "LICENSE.zig.txt"  # of the compiler's runtime, parts of which the libraries contain


@dataclasses.dataclass(frozen=True)
class Platform:
    """One kind of machine.

    Attributes
    ----------
    folders
        Its folder under `binaries/` in FMI 2.0 and 3.0; "" if FMI does not define it.
    suffix
        File suffix of a shared library.
    """

    folders: tuple[str, str]
    suffix: str


PLATFORMS = {
    "x86_64-linux": Platform(("linux64", "x86_64-linux"), ".so"),
    "aarch64-linux": Platform(("", "aarch64-linux"), ".so"),
    "x86_64-windows": Platform(("win64", "x86_64-windows"), ".dll"),
    "x86_64-darwin": Platform(("darwin64", "x86_64-darwin"), ".dylib"),
    "aarch64-darwin": Platform(("darwin64", "aarch64-darwin"), ".dylib"),
}
_SUFFIXES = {"windows": ".dll", "darwin": ".dylib"}


def this_platform() -> str:
    """Return the name of this platform, as FMI 3.0 has it."""
    machine = {"amd64": "x86_64", "arm64": "aarch64"}.get(platform.machine().lower(), platform.machine().lower())
    return f"{machine}-{platform.system().lower()}"


def platform_of(name: str) -> Platform:
    """Return one of `PLATFORMS`, or this platform.

    Raises
    ------
    edge.InputError
        If it is neither.
    """
    if name in PLATFORMS:
        return PLATFORMS[name]
    if name != this_platform():
        raise ArgumentError("platforms", f"this is none of {', '.join(PLATFORMS)}", name)
    return Platform(("", name), _SUFFIXES.get(name.rpartition("-")[2], ".so"))


def headers() -> Path:
    """Return the folder of FMI's C headers, which are part of fmpy."""
    import fmpy

    return Path(fmpy.__file__).parent / "c-code"


def own_files() -> dict[str, bytes]:
    """Return this package's sources and headers, by name, with the line ends of Unix."""
    files = [path for folder in SOURCE_FOLDERS for path in sorted(folder.glob("*.[ch]"))]
    return {**{path.name: path.read_text("utf-8").encode() for path in files}, "constants.h": constants_header()}


def source_files() -> dict[str, bytes]:
    """Return everything that is compiled, by name: this package's sources and FMI's headers."""
    return own_files() | {path.name: path.read_bytes() for path in sorted(headers().glob("fmi[23]*.h"))}


@functools.cache
def source_hash() -> str:
    """Return the hash of this package's sources, which a library of theirs contains."""
    return hashlib.sha256(repr((SOURCES, FLAGS, sorted(own_files().items()))).encode()).hexdigest()


def library_path(name: str) -> Path:
    """Return the file of the library for a platform: that of the package, or, for this machine, compiled in the cache.

    The cache is in the user's cache folder.

    Raises
    ------
    edge.InputError
        If the platform is unknown, or the package has no library for it, of its present sources, and this machine no C
        compiler for it.
    RuntimeError
        If the compiler fails.
    """
    suffix = platform_of(name).suffix
    packaged = LIBRARIES / f"{name}{suffix}"
    if packaged.exists() and source_hash().encode() in packaged.read_bytes():
        return packaged
    if name != this_platform():
        raise ArgumentError("platforms", "its library is not of the present sources; see CONTRIBUTING.md", name)
    return _compiled(suffix)


@functools.cache
def _compiled(suffix: str) -> Path:
    """Return the library that this machine's C compiler makes, compiled if it is not in the user's cache."""
    import platformdirs

    compiler = shutil.which(os.environ.get("CC") or "cc")
    file = f"{source_hash()}{suffix}"
    folder = Path(platformdirs.user_cache_dir("cycloid-fmu", appauthor=False)) / "native"
    if (folder / file).exists():
        return folder / file
    if compiler is None:
        raise ArgumentError(
            "platforms",
            "the package has no library for this platform, and no C compiler was found to make one; install one, such "
            "as gcc or clang, or state its command in the variable CC",
            this_platform(),
        )
    with tempfile.TemporaryDirectory(prefix="cycloid-fmu-") as sources:
        for name, data in source_files().items():
            (Path(sources) / name).write_bytes(data)
        command = [compiler, *FLAGS, f'-DSOURCE_HASH="{source_hash()}"', "-o", file, *SOURCES, "-lm"]
        done = subprocess.run(command, cwd=sources, capture_output=True, text=True, check=False)
        if done.returncode != 0:
            raise RuntimeError(f"{compiler} failed: {done.stderr.strip().splitlines()[-1:]}")
        data = (Path(sources) / file).read_bytes()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with edge.written_whole(folder / file) as temporary:
            temporary.write_bytes(data)
    except (OSError, edge.InputError):  # without a writable cache it lasts as long as this process
        folder = Path(tempfile.mkdtemp(prefix="cycloid-fmu-"))
        atexit.register(shutil.rmtree, folder, ignore_errors=True)
        (folder / file).write_bytes(data)
    return folder / file
