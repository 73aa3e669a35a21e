"""A reference run in every FMU, with results of the exact model, for a first test in a new tool.

The files follow the layered standard FMI-LS-REF (Modelica Association, 1.0.0-alpha.1: manifest with roles, experiments
with stimuli and references). The compared values do not depend on how a tool interpolates inputs: the inputs are
constant around each reference sample, or throughout.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from xml.etree.ElementTree import Element, SubElement, indent, register_namespace, tostring

from cycloid_fmu import edge
from cycloid_fmu.fmu.core import model_of
from cycloid_fmu.fmu.mesh import StepError
from cycloid_fmu.fmu.variables import ATTRIBUTES, Interface
from cycloid_fmu.geometry.pair import Pair
from cycloid_fmu.reducer.first_stage import FirstStage
from cycloid_fmu.surfaces.surface import ErrorSurface

FOLDER = "extra/org.fmi-standard.fmi-ls-ref"
TOLERANCE = 5e-3  # relative to the variable's largest reference
_NAMESPACE = "http://fmi-standard.org/fmi-ls-manifest"
_ABOUT = "Layered Standard providing information on related files included in an FMU."
_STEP = 1e-3  # s
Row = tuple[float, dict[str, float]]  # time, values by name


def _stimuli(
    pair: Pair, surface: ErrorSurface, interface: Interface, first_stage: FirstStage | None, ratio: float
) -> list[Row]:
    torque = 0.3 * (pair.rated_torque or 100.0)
    if interface.crank_inertia > 0.0:
        driven = {"flange_a.tau": -1.5 * torque / ratio, "flange_b.tau": torque}
        return [(time, driven) for time in (0.0, 0.005, 0.01, 0.02)]
    if interface.output_inertia > 0.0:
        resting = {"flange_a.phi": 0.4, "flange_a.w": 0.0, "flange_b.tau": torque}
        return [(0.0, resting), (0.1, resting)]
    still, rows = model_of(pair, surface, Interface(driven=interface.driven), first_stage), []
    for time, angle, load in ((0.0, 0.0, torque), (0.2, 0.4, torque), (0.4, 1.0, -torque), (0.6, -0.5, 3.0 * torque)):
        values = {"flange_a.phi": angle, "flange_a.w": 0.0}
        if interface.kind == "compliant":
            still.crank_angle, still.torque = angle, load
            still.advance(0.0)
            values |= {"flange_b.phi": float(f"{still.output_angle:.12g}"), "flange_b.w": 0.0}
        else:
            values["flange_b.tau"] = load
        rows += [(round(time - 0.1, 1), values)] if time > 0.0 else []
        rows.append((time, values))
    return rows


def run(
    pair: Pair, surface: ErrorSurface, interface: Interface, first_stage: FirstStage | None = None
) -> tuple[list[Row], list[Row]]:
    """Return stimuli and references of the run: each a list of time (s) and values by name (SI).

    Raises
    ------
    edge.InputError
        If the drive can't be brought to 0.3 and 0.9 times its rated torque.
    """
    model = model_of(pair, surface, interface, first_stage)
    stimuli = _stimuli(pair, surface, interface, first_stage, model.ratio)
    if interface.crank_inertia > 0.0:
        names: Sequence[str] = ("flange_a.phi", "flange_a.w", "flange_b.phi", "flange_b.w")
    elif interface.kind == "compliant" and interface.output_inertia == 0.0:
        names = ("flange_a.tau", "flange_b.tau", "transmission_error")
    else:
        names = ("flange_a.tau", "flange_b.phi", "transmission_error")
    references: list[Row] = []

    def put(values: Mapping[str, float]) -> None:
        for name, value in values.items():
            setattr(model, ATTRIBUTES[name], value)

    def refer(time: float) -> None:
        references.append((time, {name: float(getattr(model, ATTRIBUTES.get(name, name))) for name in names}))

    try:
        put(stimuli[0][1])
        model.check()
        model.forget_history()
        model.advance()
        refer(0.0)
        for (begin, before), (end, after) in itertools.pairwise(stimuli):
            count = round((end - begin) / _STEP)
            for i in range(1, count + 1):
                put({name: before[name] + i / count * (after[name] - before[name]) for name in after})
                model.advance(_STEP)
            if after == before:
                refer(end)
    except (StepError, ValueError) as problem:
        raise edge.InputError(f"the FMU's reference run can't be made: {problem}.") from None
    return stimuli, references


def _table(rows: Sequence[Row]) -> bytes:
    lines = [",".join(("time", *rows[0][1]))]
    lines += [",".join(f"{v:.12g}" for v in (time, *values.values())) for time, values in rows]
    return ("\n".join(lines) + "\n").encode()


def _xml(root: Element) -> bytes:
    indent(root)
    return bytes(tostring(root, encoding="utf-8", xml_declaration=True))


def reference_files(
    pair: Pair, surface: ErrorSurface, interface: Interface, first_stage: FirstStage | None = None
) -> Mapping[str, bytes]:
    """Return the run's files, {path in the archive: content}.

    Raises
    ------
    edge.InputError
        As `run`.
    """
    stimuli, references = run(pair, surface, interface, first_stage)
    told = f"computed by the exact model; tolerance {TOLERANCE:g} of the variable's largest reference"
    experiments = Element("Experiments", name="Smoke test", description=f"One run of the drive, {told}.")
    one = SubElement(
        experiments,
        "Experiment",
        name=interface.kind,
        description=f"The drive under load, {told}.",
        startTime="0.0",
        stopTime=repr(stimuli[-1][0]),
        stepSize=repr(_STEP),
        tolerance=repr(TOLERANCE),
    )
    SubElement(one, "Stimuli", source="smoke-test-in.csv", type="text/csv")
    SubElement(one, "References", source="smoke-test-ref.csv", type="text/csv")
    register_namespace("fmi-ls", _NAMESPACE)
    manifest = Element(
        "fmiReferences",
        {
            f"{{{_NAMESPACE}}}fmi-ls-name": "org.fmi-standard.fmi-ls-ref",
            f"{{{_NAMESPACE}}}fmi-ls-version": "1.0.0-alpha.1",
            f"{{{_NAMESPACE}}}fmi-ls-description": _ABOUT,
        },
    )
    for source, kind, role, text in (
        ("smoke-test.exp", "application/x-ma-hs-experiments", "experiment/smoke-test", "A test run of the FMU"),
        ("smoke-test-in.csv", "text/csv", "other", "Its inputs over time (s, SI units)"),
        ("smoke-test-ref.csv", "text/csv", "result", f"Its outputs, {told}"),
        ("../../documentation/index.html", "text/html", "document", "Interface, variables and losses"),
    ):
        SubElement(manifest, "Related", type=kind, source=source, role=role, description=text)
    return {
        f"{FOLDER}/fmi-ls-manifest.xml": _xml(manifest),
        f"{FOLDER}/smoke-test.exp": _xml(experiments),
        f"{FOLDER}/smoke-test-in.csv": _table(stimuli),
        f"{FOLDER}/smoke-test-ref.csv": _table(references),
    }
