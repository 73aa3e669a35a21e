"""From a drive to a native FMU: tables, the library for each platform, and its source."""

from __future__ import annotations

import hashlib
import math
import os
import struct
from collections.abc import Callable, Sequence
from xml.etree.ElementTree import Element, SubElement, indent, tostring

from cycloid_fmu import __version__, edge
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.edge import ArgumentError
from cycloid_fmu.fmu import tables
from cycloid_fmu.fmu.build import completed
from cycloid_fmu.fmu.constants import EVENT_INDICATORS, MOST_LOSS_ROWS
from cycloid_fmu.fmu.description import Version, model_structure, model_variables, token_of, unit_definitions
from cycloid_fmu.fmu.library import LICENCE, PLATFORMS, SOURCES, library_path, platform_of, source_files
from cycloid_fmu.fmu.parts import parts, write_archive
from cycloid_fmu.fmu.resource_file import DRIVE, sealed
from cycloid_fmu.fmu.table_cache import tables_of
from cycloid_fmu.fmu.table_file import table_body
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

IDENTIFIER = "CycloidDrive"


def platforms_of(version: Version) -> tuple[str, ...]:
    """Return the platforms of an FMI version; FMI 2.0's macOS binary holds both processors."""
    version_index = ("2.0", "3.0").index(version)
    return tuple(name for name, kind in PLATFORMS.items() if kind.folders[version_index])


def checked_platforms(platforms: Sequence[str], version: Version) -> tuple[str, ...]:
    """Return platforms once each; if there are none, all of an FMI version.

    Raises
    ------
    edge.InputError
        If one can't be built for.
    """
    names = tuple(dict.fromkeys(platforms)) or platforms_of(version)
    version_index = ("2.0", "3.0").index(version)
    for name in names:
        if not platform_of(name).folders[version_index]:
            raise ArgumentError("platforms", f"FMI {version} does not know it, FMI 3.0 does", name)
        library_path(name)
    return names


def universal(parts: dict[str, bytes]) -> bytes:
    """Return macOS libraries of both processors in one (Mach-O's fat header: big endian, pages of 16 KiB)."""
    kinds = {"x86_64-darwin": (0x01000007, 3), "aarch64-darwin": (0x0100000C, 0)}
    head, body, page = struct.pack(">II", 0xCAFEBABE, len(parts)), b"", 1 << 14
    for name, data in parts.items():
        body += bytes(-len(body) % page)
        head += struct.pack(">IIIII", *kinds[name], page + len(body), len(data), 14)
        body += data
    return head.ljust(page, b"\0") + body


def binaries(version: Version, names: Sequence[str], identifier: str) -> dict[str, bytes]:
    """Return the libraries of platforms, and a licence, by their path in an FMU with a model identifier."""
    version_index = ("2.0", "3.0").index(version)
    libraries = {name: library_path(name).read_bytes() for name in names}
    files = {"documentation/licenses/zig.txt": LICENCE.read_bytes()}
    for name, data in libraries.items():
        kind = platform_of(name)
        files[f"binaries/{kind.folders[version_index]}/{identifier}{kind.suffix}"] = data
    apple = {name: data for name, data in libraries.items() if name.endswith("darwin")}
    if version == "2.0" and len(apple) > 1:
        files[f"binaries/darwin64/{identifier}.dylib"] = universal(apple)
    return files


def _description(
    version: Version,
    token: str,
    by_reference: dict[int, Variable],
    interface: Interface,
    drive_tables: tables.Tables,
    stiffness: str,
) -> Element:
    listed = list(by_reference.values())
    text = f"Cycloid-pin gear drive, {interface.kind}, {drive_tables.accuracy}; {stiffness}"
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
    root.append(model_variables(listed, version, tuple(by_reference)))
    root.append(model_structure(listed, version, tuple(by_reference), continuous_states(interface)))
    return root


def xml_bytes(root: Element) -> bytes:
    """Return an XML file."""
    indent(root)
    return bytes(tostring(root, encoding="utf-8", xml_declaration=True))


def build_description(identifier: str) -> Element:
    """Return `sources/buildDescription.xml` of FMI 3.0."""
    root = Element("fmiBuildDescription", fmiVersion="3.0")
    configuration = SubElement(root, "BuildConfiguration", modelIdentifier=identifier)
    files = SubElement(configuration, "SourceFileSet", language="C99")
    for name in SOURCES:
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
    drive_tables: tables.Tables | None = None,
    workers: int = 1,
    total: Callable[[int], None] = lambda angles: None,
    progress: Callable[[int], None] = lambda angles: None,
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
    drive_tables
        Tables of this drive; None for those in the cache (`table_cache`), or computed ones.
    workers, total, progress
        As in `tables.compute`.

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
        libraries = binaries(fmi_version, names, IDENTIFIER)
        every = variables(drive, interface, fmi_version)
        by_reference = exchanged(from_tables(every), interface, fmi_version)
        if drive_tables is None:
            drive_tables = tables_of(
                drive.stage, largest_load=largest_torque, workers=workers, total=total, progress=progress
            )
        table = table_body(drive_tables, interface, by_reference, drive.first_stage)
        token = token_of(__version__ + hashlib.sha256(table).hexdigest())
        contents = {
            "modelDescription.xml": xml_bytes(
                _description(
                    fmi_version, token, by_reference, interface, drive_tables, stiffness_text(drive.pair, interface)
                )
            ),
            f"resources/{DRIVE.file}": sealed(table, token, DRIVE),
            **{f"sources/{name}": data for name, data in source_files().items()},
            **libraries,
            **parts(drive, interface, list(by_reference.values()), fmi_version, ()),
        }
        if fmi_version == "3.0":
            contents["sources/buildDescription.xml"] = xml_bytes(build_description(IDENTIFIER))
        write_archive(temporary, contents)
    return drive_tables
