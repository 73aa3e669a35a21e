"""Compile the library in front of pythonfmu's in an FMU of FMI 2.0: `python tests/native/front.py`."""

import hashlib
import subprocess
import tempfile
from pathlib import Path

from c_host import zig

from cycloid_fmu.native import build as native_build

NATIVE = Path(native_build.__file__).parent / "sources"
SHIPPED = NATIVE.parents[1] / "fmu" / "front"
SOURCES = (SHIPPED / "front.c", NATIVE / "uri.c")
HEADERS = (NATIVE / "format.h", NATIVE / "uri.h")
LIBRARIES = {"linux64/CycloidDrive.so": "x86_64-linux", "win64/CycloidDrive.dll": "x86_64-windows"}


def source_hash():
    """Of all that is compiled but FMI's headers."""
    text = b"".join(path.read_bytes() for path in (*SOURCES, *HEADERS))
    return hashlib.sha256(text).hexdigest()


def compiled_front(library):
    """Compile one of `LIBRARIES` and return its bytes: the same ones everywhere, with the same version of zig.

    It is compiled under its own name: a DLL contains it, and another length of it moves the bytes that follow.
    """
    with tempfile.TemporaryDirectory() as folder:  # the linker leaves more there
        made = Path(folder, Path(library).name)
        _compile(library, made)
        return made.read_bytes()


def _compile(library, target):
    if library.endswith(".dll"):  # not mingw's library, which takes minutes to compile
        parts = ("string", "private")
        runtime = [
            "-nostdlib",
            "-Wl,--no-entry",
            "-isystem",
            str(native_build.windows_headers()),
            *(f"-lapi-ms-win-crt-{part}-l1-1-0" for part in parts),
            "-lkernel32",
        ]
    else:
        runtime = ["-ldl", "-lpthread"]
    subprocess.run(
        [
            *zig(LIBRARIES[library]),
            "-std=c99",
            "-Os",
            "-Wall",
            "-Wextra",
            "-Werror",
            "-fPIC",
            "-shared",
            "-fvisibility=hidden",
            "-s",
            f'-DSOURCE_HASH="{source_hash()}"',
            "-I",
            str(NATIVE),
            "-I",
            str(native_build.headers()),
            *map(str, SOURCES),
            "-o",
            str(target),
            *runtime,
        ],
        check=True,
    )


if __name__ == "__main__":
    for name in LIBRARIES:
        (SHIPPED / name).write_bytes(compiled_front(name))
