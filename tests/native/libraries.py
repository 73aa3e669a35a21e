"""Compile the libraries that the package contains, with zig: `python tests/native/libraries.py`.

Those of native FMUs and of the joint's run-time for five platforms, and the one in front of pythonfmu's in an FMU of
FMI 2.0 for two. The same
sources and the same version of zig (`constraints.txt`) give the same bytes on every machine.
"""

import hashlib
import importlib.metadata
import os
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import ziglang

from cycloid_fmu.fmu import library
from cycloid_fmu.joint import runtime as joint

ROOT = Path(library.__file__).parents[2]
FRONT = ROOT / "cycloid_fmu" / "fmu" / "front"
UCRT = library.LIBRARIES / "ucrt.c"
TARGETS = {  # Linux no newer than GLIBC 2.17, macOS from 11
    "x86_64-linux": "x86_64-linux-gnu.2.17",
    "aarch64-linux": "aarch64-linux-gnu.2.17",
    "x86_64-windows": "x86_64-windows-gnu",
    "x86_64-darwin": "x86_64-macos.11.0",
    "aarch64-darwin": "aarch64-macos.11.0",
}
FRONTS = {FRONT / "linux64/CycloidDrive.so": "x86_64-linux", FRONT / "win64/CycloidDrive.dll": "x86_64-windows"}
PACKAGED = {library.LIBRARIES / f"{name}{kind.suffix}": name for name, kind in library.PLATFORMS.items()}
JOINTS = {joint.LIBRARIES / path.name: name for path, name in PACKAGED.items()}
_FRONT_FLAGS = ("-std=c99", "-Os", "-Wall", "-Wextra", "-Werror", "-fPIC", "-shared", "-fvisibility=hidden", "-s")


def zig(name):
    """Command of zig's compiler for a platform."""
    return (sys.executable, "-m", "ziglang", "cc", "-target", TARGETS[name])


def windows_headers():
    """Options for zig's Windows headers, which it takes by itself only with mingw's library."""
    return ("-isystem", str(Path(ziglang.__file__).parent / "lib" / "libc" / "include" / "any-windows-any"))


def windows_runtime(*more, start=UCRT):
    """Options in place of mingw's library, which takes minutes to compile; `more` parts of the C runtime for a program.

    The C runtime is Windows' own (the Universal CRT, part of it since Windows 10), but sine, cosine, exponential and
    logarithm are those of zig's compiler runtime.
    """
    parts = ("stdio", "heap", "string", "private", "math", *more)
    return (
        "-nostdlib",
        "-rtlib=compiler-rt",
        *windows_headers(),
        str(start),
        *(f"-lapi-ms-win-crt-{part}-l1-1-0" for part in parts),
        "-lkernel32",
    )


def front_files():
    """Sources and headers of the library in front, by name, without FMI's."""
    sources = library.SOURCE_FOLDERS[0]
    paths = (FRONT / "front.c", *(sources / name for name in ("uri.c", "uri.h", "format.h")))
    return {path.name: path.read_bytes() for path in paths}


def front_hash():
    """Hash of the sources, which the library in front contains."""
    return hashlib.sha256(b"".join(front_files().values())).hexdigest()


def compiled(path):
    """Bytes of one of `PACKAGED`, `JOINTS` or `FRONTS`, compiled anew."""
    if path in FRONTS:
        name, files, flags, sources, digest = (
            FRONTS[path],
            front_files(),
            _FRONT_FLAGS,
            ("front.c", "uri.c"),
            front_hash(),
        )
        files |= {header.name: header.read_bytes() for header in library.headers().glob("fmi2*.h")}
        parts = ("string", "private")
        windows = (
            "-nostdlib",
            *windows_headers(),
            *(f"-lapi-ms-win-crt-{part}-l1-1-0" for part in parts),
            "-lkernel32",
        )
        runtime = windows if name.endswith("windows") else ("-ldl", "-lpthread")
    else:
        if path in JOINTS:
            name, digest, sources = JOINTS[path], joint.source_hash(), (f"{joint.NAME}.c",)
            files = {sources[0]: joint.source()}
        else:
            name, digest, sources = PACKAGED[path], library.source_hash(), library.SOURCES
            files = library.source_files()
        flags = library.FLAGS
        files[UCRT.name] = UCRT.read_bytes()
        runtime = windows_runtime(start=UCRT.name) if name.endswith("windows") else ("-lm",)
    entry = ("-Wl,--no-entry",) if name.endswith("windows") else ()
    with tempfile.TemporaryDirectory() as folder:  # all by relative names, which libraries contain
        for file, data in files.items():
            Path(folder, file).write_bytes(data)
        target = f"{joint.NAME if path in JOINTS else 'CycloidDrive'}{path.suffix}"
        command = (*zig(name), *flags, f'-DSOURCE_HASH="{digest}"', *sources, "-o", target, *entry, *runtime)
        subprocess.run(command, cwd=folder, check=True)
        return Path(folder, target).read_bytes()


def tested_zig():
    """Version of zig that the libraries in the package are made with."""
    versions = dict(line.split("==") for line in (ROOT / "constraints.txt").read_text().split())
    return versions["ziglang"]


if __name__ == "__main__":
    if importlib.metadata.version("ziglang") != tested_zig():
        sys.exit(f"These libraries are made with the compiler of constraints.txt: pip install ziglang=={tested_zig()}")
    for folder in (library.LIBRARIES, joint.LIBRARIES):
        folder.mkdir(exist_ok=True)
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        every = (*PACKAGED, *JOINTS, *FRONTS)
        for path, data in zip(every, pool.map(compiled, every), strict=True):
            path.write_bytes(data)
            print(f"{path.relative_to(ROOT)}: {len(data)} bytes")
    library.LICENCE.write_text((Path(ziglang.__file__).parent / "LICENSE").read_text())
