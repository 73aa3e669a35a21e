"""FMUs of a compensator: its tables and the library of native FMUs; each communication step is one of its steps."""

from __future__ import annotations

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
from cycloid_fmu.fmu.variables import Variable

IDENTIFIER = "CycloidCompensator"
_STEP = 1e-3  # s, of the default experiment
_INPUTS = (
    Variable("desired_angle", "of the output", "input", unit="rad", display="deg", start=0.0),
    Variable("desired_speed", "of the output", "input", unit="rad/s", display="rev/min", start=0.0),
    Variable("load_torque", "of the environment on the output, inertia included", "input", unit="N.m", start=0.0),
    Variable("temperature", "of the drive", "input", unit="K", start=REFERENCE_TEMPERATURE),
    Variable("motor_angle_measured", "reading of the motor's encoder", "input", unit="rad", display="deg", start=0.0),
    Variable("output_angle_measured", "reading of the output's encoder", "input", unit="rad", display="deg", start=0.0),
    Variable("output_measured", "whether both readings are valid now", "input", "discrete", start=0.0, kind="boolean"),
)
_INDEX = (
    Variable(
        "index",
        "crank angle of the model where the desired output angle is 0",
        "parameter",
        "fixed",
        unit="rad",
        display="deg",
        start=0.0,
    ),
    Variable(
        "index_probability",
        "that the index is right and the drive is this one, 0 to 1",
        "parameter",
        "fixed",
        unit="1",
        start=0.0,
    ),
)
_OUTPUTS = (
    ("motor_angle", "command for the motor", "rad", "deg"),
    ("motor_speed", "speed of that command", "rad/s", "rev/min"),
    ("band", "standard deviation of the output angle from the desired one", "rad", "arcsec"),
    ("gain", "gain of the part that depends on the crank angle, 0 to 2", "1", None),
)


def variables(version: Version) -> tuple[Variable, ...]:
    """Return the FMU's variables, in the order of `compensator_model.c`; the index is the value reference."""
    time = () if version == "2.0" else (Variable("time", "time", "independent", unit="s"),)
    known = {"depends": tuple(v.name for v in _INPUTS), "initially": tuple(v.name for v in _INDEX)}
    outputs = [
        Variable(name, text, "output", unit=unit, display=display, **known)  # type: ignore[arg-type]
        for name, text, unit, display in _OUTPUTS
    ]
    holds = Variable("holds", "whether the model is valid", "output", "discrete", kind="boolean", **known)  # type: ignore[arg-type]
    return (*_INPUTS, *_INDEX, *outputs, holds, *time)


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
