"""A joint as an SSP package
=========================

A robot joint from FMUs: motor, drive and arm as an SSP package, its path error, and compensation of that error.

The drive is that of `bench_to_fmu.py`: as drawn, as identified on the bench, and as made. A controller that compensates
the identified transmission error then moves the real joint. Finally, two such joints form an arm.
"""

import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from xml.etree.ElementTree import Element, SubElement, indent, tostring

import bench_to_fmu
import numpy as np
from fmpy import read_model_description
from joint_parts import END, Motor, moved
from matplotlib.figure import Figure
from numpy.typing import NDArray

import cycloid_fmu as cy

HERE, OUT = Path(__file__).parent, Path("joint_package_out")
ARM = cy.Interface("compliant", output_inertia=2.0)  # kg·m², of the arm, in the FMU with the stiff contacts
COMPONENTS = {"motor": "Motor.fmu", "drive": "drive.fmu", "arm": "Arm.fmu"}
CONNECTIONS = (
    ("motor", "flange.phi", "drive", "flange_a.phi"),
    ("motor", "flange.w", "drive", "flange_a.w"),
    ("drive", "flange_a.tau", "motor", "flange.tau"),
    ("drive", "flange_b.phi", "arm", "flange.phi"),
    ("arm", "flange.tau", "drive", "flange_b.tau"),
)
Array = NDArray[np.float64]


def write_ssp(path: Path, fmus: Path) -> None:
    """Package the joint's FMUs as an SSP: components, connectors and connections in `SystemStructure.ssd`."""
    ns = "http://ssp-standard.org/SSP1/SystemStructure"
    common = f"{ns}Common"
    root = Element(f"{{{ns}Description}}SystemStructureDescription", name="joint", version="1.0")
    system = SubElement(root, f"{{{ns}Description}}System", name="joint")
    elements = SubElement(system, f"{{{ns}Description}}Elements")
    for component, file in COMPONENTS.items():
        node = SubElement(
            elements,
            f"{{{ns}Description}}Component",
            name=component,
            type="application/x-fmu-sharedlibrary",
            source=f"resources/{file}",
        )
        connectors = SubElement(node, f"{{{ns}Description}}Connectors")
        for variable in read_model_description(str(fmus / file), validate=False).modelVariables:
            if variable.causality in ("input", "output") and variable.type == "Real":
                connector = SubElement(
                    connectors, f"{{{ns}Description}}Connector", name=variable.name, kind=variable.causality
                )
                SubElement(connector, f"{{{common}}}Real")
    connections = SubElement(system, f"{{{ns}Description}}Connections")
    for a, start, b, stop in CONNECTIONS:
        SubElement(
            connections,
            f"{{{ns}Description}}Connection",
            startElement=a,
            startConnector=start,
            endElement=b,
            endConnector=stop,
        )
    SubElement(root, f"{{{ns}Description}}DefaultExperiment", startTime="0", stopTime=str(END))
    indent(root)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("SystemStructure.ssd", tostring(root, encoding="utf-8", xml_declaration=True))
        for file in COMPONENTS.values():
            archive.write(fmus / file, f"resources/{file}")


def joint(drive: cy.Drive, path: Path) -> Path:
    """Build the joint's three FMUs and package them."""
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        drive.build_fmu(place / "drive.fmu", interface=ARM)
        for name in ("Motor", "Arm"):
            script = place / f"{name.lower()}_part.py"
            script.write_text(f"from joint_parts import {name} as Part\n\n\nclass {name}(Part):\n    pass\n")
            # In a separate process, because the builder leaves its imported modules loaded.
            words = ["build", "-f", script, "-d", place / f"{name}.fmu", HERE / "joint_parts.py"]
            subprocess.run([sys.executable, "-m", "pythonfmu", *map(str, words)], check=True, cwd=HERE)
        write_ssp(path, place)
    return path


def compensation(fmu: Path, load: float) -> dict[str, float]:
    """Largest orders of a drive's transmission error over one output turn, as parameters of the motor."""
    turns, samples = 39, 64
    crank = 2.0 * np.pi * np.arange(turns * samples) / samples
    error = cy.simulate_fmu(fmu, crank, load, ("transmission_error",))["transmission_error"]
    spectrum = np.fft.rfft(error)[: turns * 4] * 2.0 / error.size
    strongest = np.argsort(-np.abs(spectrum[1:]))[: Motor.ORDERS] + 1
    found = {}
    for i, k in enumerate(strongest, start=1):
        found |= {f"order_{i}": k / turns, f"cosine_{i}": spectrum[k].real, f"sine_{i}": -spectrum[k].imag}
    return found


def correction(parameters: Mapping[str, float], crank: Array) -> Array:
    """Transmission error at a crank angle from the orders of `compensation`, rad."""
    return sum(
        parameters[f"cosine_{i}"] * np.cos(parameters[f"order_{i}"] * crank)
        + parameters[f"sine_{i}"] * np.sin(parameters[f"order_{i}"] * crank)
        for i in range(1, Motor.ORDERS + 1)
    )


def tip_error(fmu: Path, parameters: Mapping[str, float] | None) -> tuple[Array, Array]:
    """Move the tip of a two-joint arm along a line; return its position (m) and its error (µm)."""
    upper, lower, mass = 0.4, 0.35, 6.0
    line = np.linspace((0.35, -0.45), (0.6, -0.2), 1500)
    distance = np.hypot(*line.T)
    elbow = np.arccos((distance**2 - upper**2 - lower**2) / (2.0 * upper * lower))
    shoulder = np.arctan2(line[:, 1], line[:, 0]) - np.arctan2(lower * np.sin(elbow), upper + lower * np.cos(elbow))
    weight = 9.81 * mass
    loads = (
        -weight * (upper * np.cos(shoulder) + 0.5 * lower * np.cos(shoulder + elbow)),
        -weight * 0.5 * lower * np.cos(shoulder + elbow),
    )
    reached = []
    for angle, load in zip((shoulder, elbow), loads, strict=True):
        crank = -39.0 * angle
        if parameters is not None:
            crank = crank + 39.0 * correction(parameters, crank)
        reached.append(cy.simulate_fmu(fmu, crank, load, ("flange_b.phi",))["flange_b.phi"])
    first, second = reached[0], reached[0] + reached[1]
    tip = np.column_stack(
        [upper * np.cos(first) + lower * np.cos(second), upper * np.sin(first) + lower * np.sin(second)]
    )
    return line, (tip - line) * 1e6


def main() -> None:
    OUT.mkdir(exist_ok=True)
    identified = bench_to_fmu.OUT / "identified.nc"
    if not identified.exists():
        bench_to_fmu.main()
    drives = {
        "as drawn": cy.read_drive(HERE / "drive-39-40.toml"),
        "as identified": cy.read_drive(HERE / "drive-39-40.toml", identified),
        "as made": cy.read_drive(HERE / "drive-39-40-as-made.toml"),
    }
    print("1. The joint as an SSP package, with each drive")
    packages = {name: joint(drive, OUT / f"joint-{name.replace(' ', '-')}.ssp") for name, drive in drives.items()}
    drives["as identified"].build_fmu(OUT / "identified.fmu")
    drives["as made"].build_fmu(OUT / "as-made.fmu")
    known = compensation(OUT / "identified.fmu", -30.0)

    print("2. It moves by 90°")
    cases = {name: (path, {}) for name, path in packages.items()}
    cases["as made, identified error compensated"] = packages["as made"], known
    # Each run has its own process: pythonfmu 0.7 can't instantiate different scripts of the same name in one.
    with ProcessPoolExecutor(2, get_context("spawn"), max_tasks_per_child=1) as pool:
        runs = dict(zip(cases, pool.map(moved, *zip(*cases.values(), strict=True)), strict=True))

    print("3. Two such joints move a tip along a line")
    line, before = tip_error(OUT / "as-made.fmu", None)
    _, after = tip_error(OUT / "as-made.fmu", known)

    figure = Figure(figsize=(9.0, 5.6), layout="constrained")
    axes = figure.subplots(2)
    for name, (time, error) in runs.items():
        # The identified curve coincides with the actual one: drawn dashed, above it.
        style = {"ls": "--", "zorder": 3} if name == "as identified" else {}
        axes[0].plot(time, error * cy.ARCSEC, lw=1.0, label=name, **style)
        whole, rms = np.ptp(error[time > 0.1]) * cy.ARCSEC, error.std() * cy.ARCSEC
        print(f"   {name}: path error {whole:.1f}″ peak to peak, {rms:.1f}″ rms")
    axes[0].set(xlabel="time [s]", ylabel="path error of the joint [arcsec]")
    axes[0].legend(fontsize="small", ncols=4, frameon=False, loc="lower center", bbox_to_anchor=(0.5, 1.0))
    along = np.hypot(*(line - line[0]).T) * 1e3
    for name, error in (("before", before), ("compensated", after)):
        size = np.hypot(*(error - error.mean(axis=0)).T)
        axes[1].plot(along, size, lw=1.0, label=name)
        print(f"   tip error about its mean, {name}: {np.sqrt(np.mean(size**2)):.1f} µm rms")
    axes[1].set(xlabel="position along the line [mm]", ylabel="tip error [µm]")
    axes[1].legend(fontsize="small")
    for axis in axes:
        axis.grid(alpha=0.3)
    figure.savefig(OUT / "joint_package.png", dpi=150)
    print(f"See {OUT / 'joint_package.png'}.")


if __name__ == "__main__":
    main()
# sphinx_gallery_thumbnail_number = -1
