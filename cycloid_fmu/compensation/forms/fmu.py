"""FMUs of a compensator: its tables and the library of native FMUs; each communication step is one of its steps."""

from __future__ import annotations

import dataclasses
import hashlib
import html
import os
from collections.abc import Sequence
from xml.etree.ElementTree import Element, SubElement

from cycloid_fmu import __version__, edge
from cycloid_fmu.compensation.compensator import Compensator
from cycloid_fmu.compensation.forms.numbers import about, table_body
from cycloid_fmu.fmu import native
from cycloid_fmu.fmu.constants import REFERENCE_TEMPERATURE
from cycloid_fmu.fmu.description import Version, model_structure, model_variables, token_of, unit_definitions
from cycloid_fmu.fmu.library import SOURCES, source_files
from cycloid_fmu.fmu.parts import licences, write_archive
from cycloid_fmu.fmu.resource_file import COMPENSATOR, sealed
from cycloid_fmu.fmu.variables import Variable, listed_variables

IDENTIFIER = "CycloidCompensator"
_STEP = 1e-3  # s, of the default experiment


def variables(version: Version) -> tuple[Variable, ...]:
    """Return the FMU's variables, in the order of `compensator_model.c`; the index is the value reference."""
    listed = listed_variables("cycloid_fmu.compensation.forms")
    listed["temperature"] = dataclasses.replace(listed["temperature"], start=REFERENCE_TEMPERATURE)
    inputs, parameters = (
        tuple(name for name, v in listed.items() if v.causality == causality) for causality in ("input", "parameter")
    )
    for name, variable in listed.items():
        if variable.causality == "output":
            listed[name] = dataclasses.replace(variable, depends=inputs, initially=parameters)
    time = () if version == "2.0" else (Variable("time", "time", "independent", unit="s"),)
    return (*listed.values(), *time)


def build_compensator_fmu(
    compensator: Compensator,
    path: str | os.PathLike[str],
    *,
    fmi_version: Version = "2.0",
    platforms: Sequence[str] = (),
) -> None:
    """Write a compensator's FMU, which needs no Python; never a partial file.

    Parameters
    ----------
    compensator, path
        The compensator, and the file.
    fmi_version, platforms
        As of `cycloid_fmu.fmu.native.build_native`.

    Raises
    ------
    edge.InputError
        If the folder does not exist or a platform can't be built for.
    """
    names = native.checked_platforms(platforms, fmi_version)
    listed = variables(fmi_version)
    table = table_body(compensator, listed)
    token = token_of(__version__ + hashlib.sha256(table).hexdigest())
    with edge.written_whole(path) as temporary:
        contents = {
            "modelDescription.xml": native.xml_bytes(_description(compensator, fmi_version, token, listed)),
            f"resources/{COMPENSATOR.file}": sealed(table, token, COMPENSATOR),
            **{f"sources/{name}": data for name, data in source_files().items()},
            **native.binaries(fmi_version, names, IDENTIFIER),
            "documentation/index.html": _page(compensator, listed).encode(),
            "documentation/licenses/license.txt": licences(()).encode(),
        }
        if fmi_version == "3.0":
            contents["sources/buildDescription.xml"] = native.xml_bytes(native.build_description(IDENTIFIER))
        write_archive(temporary, contents)


def _description(c: Compensator, version: Version, token: str, table: Sequence[Variable]) -> Element:
    root = Element(
        "fmiModelDescription",
        {
            "fmiVersion": version,
            "modelName": IDENTIFIER,
            "guid" if version == "2.0" else "instantiationToken": token,
            "description": about(c),
            "author": "cycloid-fmu",
            "version": __version__,
            "license": "MIT",
            "generationTool": f"cycloid-fmu {__version__}",
            "variableNamingConvention": "structured",
        },
    )
    state = "FMUstate" if version == "2.0" else "FMUState"
    offered = SubElement(
        root,
        "CoSimulation",
        {
            "modelIdentifier": IDENTIFIER,
            f"canGetAndSet{state}": "true",
            f"canSerialize{state}": "true",
            "canHandleVariableCommunicationStepSize": "true",
            **({"canNotUseMemoryManagementFunctions": "true"} if version == "2.0" else {}),
        },
    )
    if version == "2.0":
        files = SubElement(offered, "SourceFiles")
        for name in SOURCES:
            SubElement(files, "File", name=name)
    root.append(unit_definitions(table))
    categories = SubElement(root, "LogCategories")
    SubElement(categories, "Category", name="logStatusError", description="refused values")
    SubElement(root, "DefaultExperiment", startTime="0.0", stopTime="1.0", stepSize=repr(_STEP))
    root.append(model_variables(table, version))
    root.append(model_structure(table, version))
    return root


def _page(c: Compensator, table: Sequence[Variable]) -> str:
    rows = "".join(
        f"<tr><td><code>{v.name}</code><td>{v.causality}<td>{v.unit or ''}<td>{html.escape(v.description)}</tr>\n"
        for v in table
    )
    return f"""<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><title>Compensator</title></head><body>
<h1>Compensator of a cycloid drive</h1>
<p>{html.escape(about(c))} Made by cycloid-fmu {__version__}.</p>
<p>Each communication step, of any length, is one step of the compensator with the current inputs. Before the first step
the outputs are those of a step that is not stored.</p>
<table><tr><th>name<th>causality<th>unit<th>meaning</tr>
{rows}</table></body></html>
"""
