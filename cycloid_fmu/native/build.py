"""From a drive to a native FMU: tables, the C source around them, and a binary for each platform."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import importlib.metadata
import importlib.util
import math
import os
import platform
import shutil
import struct
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from xml.etree.ElementTree import Element, SubElement, indent, tostring

from cycloid_fmu import __version__, edge
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.edge import ArgumentError, missing_package
from cycloid_fmu.fmu.build import completed
from cycloid_fmu.fmu.constants import EVENT_INDICATORS, MOST_LOSS_ROWS
from cycloid_fmu.fmu.description import Version, model_structure, model_variables, token_of, unit_definitions
from cycloid_fmu.fmu.parts import parts, write_archive
from cycloid_fmu.fmu.variables import (
    Interface,
    InterfaceKind,
    Variable,
    exchanged,
    from_tables,
    stiffness_text,
    variables,
)
from cycloid_fmu.fmu.variables import states as continuous_states
from cycloid_fmu.native import tables
from cycloid_fmu.native.table_cache import tables_of
from cycloid_fmu.native.table_file import TABLE, constants_header, named, write

IDENTIFIER = "CycloidDrive"
SOURCES = (
    "fmi2.c",
    "fmi3.c",
    "instance.c",
    "drive.c",
    "kinematic.c",
    "reducer.c",
    "compliant.c",
    "exchange.c",
    "derivatives.c",
    "teeth.c",
    "table_contacts.c",
    "exact_contacts.c",
    "clockwork.c",
    "friction.c",
    "losses.c",
    "table.c",
    "table_file.c",
    "uri.c",
)
SOURCE_FOLDER = Path(__file__).with_name("sources")
_FLAGS = ("-std=c99", "-O2", "-fPIC", "-shared", "-fvisibility=hidden", "-ffp-contract=off", "-s")
_UCRT = Path(__file__).with_name("windows") / "ucrt.c"


@dataclasses.dataclass(frozen=True)
class Platform:
    """One kind of machine.

    Attributes
    ----------
    folders
        Its folder under `binaries/` in FMI 2.0 and 3.0; "" if FMI does not define it.
    target
        Argument of `zig cc -target`: Linux no newer than GLIBC 2.17, macOS from 11.
    suffix
        File suffix of a shared library.
    """

    folders: tuple[str, str]
    target: str
    suffix: str


PLATFORMS = {
    "x86_64-linux": Platform(("linux64", "x86_64-linux"), "x86_64-linux-gnu.2.17", ".so"),
    "aarch64-linux": Platform(("", "aarch64-linux"), "aarch64-linux-gnu.2.17", ".so"),
    "x86_64-windows": Platform(("win64", "x86_64-windows"), "x86_64-windows-gnu", ".dll"),
    "x86_64-darwin": Platform(("darwin64", "x86_64-darwin"), "x86_64-macos.11.0", ".dylib"),
    "aarch64-darwin": Platform(("darwin64", "aarch64-darwin"), "aarch64-macos.11.0", ".dylib"),
}


def platforms_of(version: Version) -> tuple[str, ...]:
    """Return the platforms of an FMI version; FMI 2.0's macOS binary holds both processors."""
    place = ("2.0", "3.0").index(version)
    return tuple(name for name, one in PLATFORMS.items() if one.folders[place])


def checked_platforms(platforms: Sequence[str], version: Version) -> tuple[str, ...]:
    """Return platforms once each; if there are none, all of an FMI version.

    Raises
    ------
    edge.InputError
        If one can't be built for.
    """
    names = tuple(dict.fromkeys(platforms)) or platforms_of(version)
    for name in names:
        _compiler(name)
        if name not in platforms_of(version):
            raise ArgumentError("platforms", f"FMI {version} does not know it, FMI 3.0 does", name)
    return names


def this_platform() -> str:
    """Return the name of this platform, a key of `PLATFORMS` if supported."""
    machine = {"amd64": "x86_64", "arm64": "aarch64"}.get(platform.machine().lower(), platform.machine().lower())
    return f"{machine}-{platform.system().lower()}"


def headers() -> Path:
    """Return the folder of FMI's C headers, which are part of fmpy."""
    import fmpy

    return Path(fmpy.__file__).parent / "c-code"


def _compiler(name: str) -> list[str]:
    """Command that compiles for a platform: zig; for this machine that of CC, or without zig the system's compiler."""
    if name not in PLATFORMS:
        raise ArgumentError("platforms", f"this is none of {', '.join(PLATFORMS)}", name)
    given = os.environ.get("CC", "")
    system = shutil.which(given or "cc")
    own = name == this_platform() and system is not None
    if importlib.util.find_spec("ziglang") is not None and not (own and given):
        return [sys.executable, "-m", "ziglang", "cc", "-target", PLATFORMS[name].target]
    if own:
        return [str(system)]
    other = f" (or give {this_platform()} alone)" if system else ""
    raise ArgumentError("platforms", missing_package("ziglang", "native") + other, name)


def windows_headers() -> Path:
    """Return the folder of zig's Windows headers, which are available only with mingw's library."""
    (zig,) = importlib.util.find_spec("ziglang").submodule_search_locations  # type: ignore[union-attr, misc]
    return Path(zig, "lib", "libc", "include", "any-windows-any")


def windows_runtime(*more: str) -> list[str]:
    """Return the sources and libraries for zig on Windows in place of mingw's library, which takes minutes to compile.

    The C runtime is Windows' own (the Universal CRT, part of it since Windows 10), but sine, cosine, exponential and
    logarithm are those of zig's compiler runtime.

    Parameters
    ----------
    more
        Further parts of it that a program needs, such as "time".
    """
    parts = ("stdio", "heap", "string", "private", "math", *more)
    return [
        "-nostdlib",
        "-rtlib=compiler-rt",
        "-isystem",
        str(windows_headers()),
        str(_UCRT),
        *(f"-lapi-ms-win-crt-{part}-l1-1-0" for part in parts),
        "-lkernel32",
    ]


def _source_files() -> dict[str, bytes]:
    """Return the compiled files, by name: our sources and FMI's headers."""
    files = (*sorted(SOURCE_FOLDER.glob("*.[ch]")), *sorted(headers().glob("fmi[23]*.h")))
    return {**{path.name: path.read_bytes() for path in files}, "constants.h": constants_header()}


def binary(name: str) -> bytes:
    """Return the shared library for a platform, which does not depend on the drive, as `library` does."""
    return library(name, _source_files(), SOURCES)


def library(name: str, files: Mapping[str, bytes], sources: Sequence[str]) -> bytes:
    """Return a shared library for a platform, compiled if it is not in the cache.

    It is kept in the user's cache folder under the hash of its source and compiler.

    Parameters
    ----------
    name
        A key of `PLATFORMS`.
    files
        Sources and headers, by name.
    sources
        Names of the sources to compile.

    Raises
    ------
    edge.InputError
        If the platform is unknown, or no compiler for it is installed.
    RuntimeError
        If the compiler fails.
    """
    import platformdirs

    command = [*_compiler(name), *_FLAGS]
    zig = "ziglang" in command
    runtime = ["-Wl,--no-entry", *windows_runtime()] if zig and name.endswith("windows") else ["-lm"]
    # Without the folder of zig, so that another environment with the same version finds the library.
    compiler = f"ziglang {importlib.metadata.version('ziglang')}" if zig else command[0]
    words = [compiler, *(word for word in (*command[1:], *runtime) if not Path(word).is_absolute())]
    origin = repr((words, _UCRT.read_bytes(), sorted(files.items())))
    digest = hashlib.sha256(origin.encode()).hexdigest()
    kept = Path(platformdirs.user_cache_dir("cycloid-fmu", appauthor=False)) / "native"
    target = kept / f"{digest}-{name}{PLATFORMS[name].suffix}"
    with contextlib.suppress(OSError):
        return target.read_bytes()
    with tempfile.TemporaryDirectory(prefix="cycloid-fmu-") as folder:
        place, made = Path(folder), Path(folder) / f"made{PLATFORMS[name].suffix}"
        for file, data in files.items():
            (place / file).write_bytes(data)
        done = subprocess.run(
            [*command, "-o", made.name, *sources, *runtime],
            cwd=place,
            capture_output=True,
            text=True,
            check=False,
            env=_environment(place) if zig else None,
        )
        if done.returncode != 0:
            raise RuntimeError(f"the compiler for {name} failed: {done.stderr.strip().splitlines()[-1:]}")
        library = made.read_bytes()
    with contextlib.suppress(OSError, edge.InputError):  # without a writable cache it is not kept
        kept.mkdir(parents=True, exist_ok=True)
        with edge.written_whole(target) as temporary:
            temporary.write_bytes(library)
    return library


def _environment(folder: Path) -> dict[str, str]:
    """Return the environment of zig, with a cache in `folder` if its own can't be written."""
    import platformdirs

    own = Path(os.environ.get("ZIG_GLOBAL_CACHE_DIR") or platformdirs.user_cache_dir("zig", appauthor=False))
    try:
        own.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=own):
            return dict(os.environ)
    except OSError:
        return {**os.environ, "ZIG_GLOBAL_CACHE_DIR": str(folder / "zig")}


def universal(parts: dict[str, bytes]) -> bytes:
    """Return macOS libraries of both processors in one (Mach-O's fat header: big endian, pages of 16 KiB)."""
    kinds = {"x86_64-darwin": (0x01000007, 3), "aarch64-darwin": (0x0100000C, 0)}
    head, body, page = struct.pack(">II", 0xCAFEBABE, len(parts)), b"", 1 << 14
    for name, data in parts.items():
        body += bytes(-len(body) % page)
        head += struct.pack(">IIIII", *kinds[name], page + len(body), len(data), 14)
        body += data
    return head.ljust(page, b"\0") + body


def binaries(
    version: Version, names: Sequence[str], done: Callable[[str], None], identifier: str, of: Callable[[str], bytes]
) -> dict[str, bytes]:
    """Return the libraries `of` platforms by their path in an FMU with a model identifier."""
    place, made = ("2.0", "3.0").index(version), {}
    for name in names:
        made[name] = of(name)
        done(name)
    found = {}
    for name, data in made.items():
        one = PLATFORMS[name]
        found[f"binaries/{one.folders[place]}/{identifier}{one.suffix}"] = data
    apple = {n: d for n, d in made.items() if n.endswith("darwin")}
    if version == "2.0" and len(apple) > 1:
        found[f"binaries/darwin64/{identifier}.dylib"] = universal(apple)
    return found


def _description(
    version: Version,
    token: str,
    kept: dict[int, Variable],
    interface: Interface,
    made: tables.Tables,
    stiffness: str,
) -> Element:
    listed = list(kept.values())
    text = f"Cycloid-pin gear drive, {interface.kind}, {made.told}; {stiffness}"
    common = {
        "fmiVersion": version,
        "modelName": IDENTIFIER,
        "guid" if version == "2.0" else "instantiationToken": token,
        "description": text,
        "author": "cycloid-fmu",
        "version": __version__,
        "license": "MIT",
        "generationTool": f"cycloid-fmu {__version__}",
        "variableNamingConvention": "structured",
    }
    exchanges = not interface.support_flange
    if version == "2.0" and exchanges:
        common["numberOfEventIndicators"] = str(EVENT_INDICATORS)
    root = Element("fmiModelDescription", common)
    state = "FMUstate" if version == "2.0" else "FMUState"
    both = {
        "modelIdentifier": IDENTIFIER,
        f"canGetAndSet{state}": "true",
        f"canSerialize{state}": "true",
    }
    if exchanges:
        both["providesDirectionalDerivative" + ("" if version == "2.0" else "s")] = "true"
    if version == "2.0":
        both["canNotUseMemoryManagementFunctions"] = "true"
    elif exchanges:
        both["providesAdjointDerivatives"] = "true"
    exchange = {} if version == "2.0" else {"needsCompletedIntegratorStep": "true"}
    simulation = {"canHandleVariableCommunicationStepSize": "true"}
    if version == "3.0" and interface.output_inertia > 0.0:  # at an impact
        simulation |= {"hasEventMode": "true", "mightReturnEarlyFromDoStep": "true"}
    offers = [("ModelExchange", exchange)] if exchanges else []
    for name, own in (*offers, ("CoSimulation", simulation)):
        offered = SubElement(root, name, both | own)
        if version == "2.0":
            files = SubElement(offered, "SourceFiles")
            for source in SOURCES:
                SubElement(files, "File", name=source)
    root.append(unit_definitions(listed))
    categories = SubElement(root, "LogCategories")
    for name, why in (("logStatusWarning", "torques beyond the tables"), ("logStatusError", "refused values")):
        SubElement(categories, "Category", name=name, description=why)
    SubElement(root, "DefaultExperiment", startTime="0.0", stopTime="1.0", stepSize=repr(interface.step))
    root.append(model_variables(listed, version, tuple(kept)))
    root.append(model_structure(listed, version, tuple(kept), continuous_states(interface)))
    return root


def xml_bytes(root: Element) -> bytes:
    """Return an XML file."""
    indent(root)
    return bytes(tostring(root, encoding="utf-8", xml_declaration=True))


def build_description(identifier: str, sources: Sequence[str]) -> Element:
    """Return `sources/buildDescription.xml` of FMI 3.0."""
    root = Element("fmiBuildDescription", fmiVersion="3.0")
    configuration = SubElement(root, "BuildConfiguration", modelIdentifier=identifier)
    files = SubElement(configuration, "SourceFileSet", language="C99")
    for name in sources:
        SubElement(files, "SourceFile", name=name)
    return root


def build_native(
    drive: DriveValue,
    path: str | os.PathLike[str],
    *,
    interface: InterfaceKind | Interface = "kinematic",
    fmi_version: Version = "2.0",
    platforms: Sequence[str] = (),
    largest_torque: float | None = None,
    made: tables.Tables | None = None,
    workers: int = 1,
    total: Callable[[int], None] = lambda angles: None,
    progress: Callable[[int], None] = lambda angles: None,
    compiled: Callable[[str], None] = lambda name: None,
) -> tables.Tables:
    """Write an FMU for Model Exchange and Co-Simulation that needs no Python, never a partial file; return its tables.

    Parameters
    ----------
    drive, path, interface, fmi_version
        As in `cycloid_fmu.fmu.build.build_fmu`.
    platforms
        Keys of `PLATFORMS`; if empty, all of the FMI version.
    largest_torque
        Largest torque of the tables, N·m; None for 2.5 times the rated torque. Beyond, they have no stated accuracy.
    made
        Tables of this drive; None for those in the cache (`table_cache`), or computed ones.
    workers, total, progress
        As in `tables.compute`.
    compiled
        Called with each platform whose library is ready.

    Raises
    ------
    edge.InputError
        If the folder does not exist, a platform can't be built for, or the interface is not available for this drive.
    """
    drive = drive.at_own_age
    interface = completed(interface, drive)
    if len(interface.losses) > MOST_LOSS_ROWS:
        raise ArgumentError("losses", f"has {len(interface.losses)} rows; a native FMU has {MOST_LOSS_ROWS} at most")
    names = checked_platforms(platforms, fmi_version)
    if largest_torque is not None and not 0.0 < largest_torque < math.inf:
        raise ArgumentError("largest_torque", "it must be finite and above zero (N*m)", largest_torque)
    with edge.written_whole(path) as temporary:
        libraries = binaries(fmi_version, names, compiled, IDENTIFIER, binary)
        every = variables(drive, interface, fmi_version)
        kept = exchanged(from_tables(every), interface, fmi_version)
        if made is None:
            made = tables_of(drive.stage, largest_load=largest_torque, workers=workers, total=total, progress=progress)
        table = write(made, interface, kept, first_stage=drive.first_stage)
        token = token_of(__version__ + hashlib.sha256(table).hexdigest())
        contents = {
            "modelDescription.xml": xml_bytes(
                _description(fmi_version, token, kept, interface, made, stiffness_text(drive.pair, interface))
            ),
            f"resources/{TABLE}": named(table, token),
            **{f"sources/{name}": data for name, data in _source_files().items()},
            **libraries,
            **parts(drive, interface, list(kept.values()), fmi_version, ()),
        }
        if fmi_version == "3.0":
            contents["sources/buildDescription.xml"] = xml_bytes(build_description(IDENTIFIER, SOURCES))
        write_archive(temporary, contents)
    return made
