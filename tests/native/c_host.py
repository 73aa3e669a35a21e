"""Shared by the tests of the native FMU: its interfaces, an instance of one, and compiling C for it."""

import dataclasses
import math
import os
import shutil
import subprocess
import sys
from pathlib import Path

import fmpy
import pytest
from fmpy.fmi2 import FMU2Slave

from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.fmu import library, table_cache, tables
from cycloid_fmu.fmu import native as native_build
from cycloid_fmu.fmu.variables import Interface, LossRipple

HERE = Path(__file__).parent
INTERFACES = {
    "kinematic": Interface(losses=((0.0, 0.9, 0.85, 0.01, 0.02), (100.0, 0.95, 0.9, 0.02, 0.03))),
    "compliant": Interface("compliant", mesh_damping=0.0),
    "inertia": Interface("compliant", 0.5, mesh_damping=0.0),
    "rotor": Interface("compliant", crank_inertia=1e-3, mesh_damping=0.0),
}
RIPPLE = LossRipple(  # of 5 to 30 % of the losses in `INTERFACES`
    orders=(1.0, 40.0 / 39.0, 40.0),
    speeds=(0.0, 15.0, 80.0),
    loads=(0.0, 0.5, 4.0),
    parts=tuple(
        tuple(
            tuple(
                tuple(
                    tuple(
                        (fast * load * 5e-3 * math.cos(flank + k), load * 4e-3 * math.sin(driven + k)) for k in range(3)
                    )
                    for load in (0.0, 0.3, 4.0)
                )
                for driven in (1, 2)
            )
            for flank in (3, 5)
        )
        for fast in (2.0, 1.0, 1.5)
    ),
)
BUILT = {
    **INTERFACES,  # interfaces of the C host
    "joint": Interface(
        "compliant", 2.0, INTERFACES["kinematic"].losses, crank_inertia=1e-3, mesh_damping=0.0, loss_ripple=RIPPLE
    ),
}


# The system's compiler where there is one: it is done sooner than zig, which the tests bring along.
COMPILER = ("cc",) if shutil.which("cc") else (sys.executable, "-m", "ziglang", "cc")


def compiled(target, sources, *flags, compiler=COMPILER):
    """Compile C sources with FMI's headers."""
    include = [option for folder in (library.headers(), *library.SOURCE_FOLDERS) for option in ("-I", str(folder))]
    libraries = [] if target.suffix == ".exe" else ["-ldl", "-lm"]
    subprocess.run(
        [*compiler, "-std=c99", "-g", *flags, *include, *map(str, sources), "-o", str(target), *libraries],
        check=True,
    )
    return target


class Slave:
    """A native FMI 2.0 FMU in fmpy; values by name, log messages in `said`."""

    def __init__(self, path, folder):
        description = fmpy.read_model_description(str(path))
        self.references = {v.name: v.valueReference for v in description.modelVariables}
        self.said = []
        self.fmi = FMU2Slave(
            guid=description.guid,
            unzipDirectory=fmpy.extract(str(path), unzipdir=str(folder)),
            modelIdentifier=description.coSimulation.modelIdentifier,
            instanceName="drive",
        )
        logger = fmpy.fmi2.fmi2CallbackLoggerTYPE(lambda *words: self.said.append(words[4].decode()))
        self._kept = fmpy.fmi2.fmi2CallbackFunctions(
            logger,
            fmpy.fmi2.fmi2CallbackAllocateMemoryTYPE(fmpy.calloc),
            fmpy.fmi2.fmi2CallbackFreeMemoryTYPE(fmpy.free),
        )
        self.fmi.instantiate(callbacks=self._kept)

    def start(self, **values):
        self.put(**values)
        self.fmi.setupExperiment(startTime=0.0)
        self.fmi.enterInitializationMode()
        self.fmi.exitInitializationMode()

    def put(self, **values):
        for name, value in values.items():
            name = name.replace("flange_a_", "flange_a.").replace("flange_b_", "flange_b.")
            setter = self.fmi.setBoolean if name == "backlash_on" else self.fmi.setReal
            setter([self.references[name]], [value])

    def get(self, *names):
        return self.fmi.getReal([self.references[name] for name in names])


@dataclasses.dataclass(frozen=True, eq=False)
class Tabled(DriveValue):
    """A drive with its tables."""

    tables: object = None


def coarse(drive, accuracy):
    """Tables that take little time: of a coarse accuracy, and compared with the model at few places."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tables, "PROBES", 1000)
        return table_cache.tables_of(drive, accuracy=accuracy)


def native_of(folder, drive, made, interface):
    """A native FMU for this machine."""
    native_build.build_native(
        drive, folder / "drive.fmu", interface=interface, drive_tables=made, platforms=[library.this_platform()]
    )
    return folder / "drive.fmu"


def run_host(program, library, uri, guid, *words, prefix=(), **environment):
    """Run the C host."""
    return subprocess.run(
        [*prefix, str(program), str(library), uri, guid, *map(str, words)],
        capture_output=True,
        text=True,
        timeout=900,
        env={**os.environ, **environment},
        check=False,
    )


def needs(program):
    return pytest.mark.skipif(shutil.which(program) is None, reason=f"{program} is not installed")


WINE = shutil.which("wine64") or "/usr/lib/wine/wine64"
needs_wine = pytest.mark.skipif(not os.path.exists(WINE), reason="wine64 is not installed")
