"""The run-time of a joint as files: one C source, the libraries made of it, and the Python module that loads them."""

from __future__ import annotations

import functools
import hashlib
import os
import re
from pathlib import Path

from cycloid_fmu import edge
from cycloid_fmu.fmu import library
from cycloid_fmu.joint import joint_drive
from cycloid_fmu.joint.document import Joint, refused_as_input

FOLDER = Path(__file__).parent
LIBRARIES = FOLDER / "libraries"
NAME = "joint_drive"
_FRICTION = ("friction.c", "losses.c")
"""Sources of the FMU's model in time that the joint shares."""
_INCLUDE = re.compile(r'^#include "(\S+)"\n', re.MULTILINE)


@functools.cache
def source() -> bytes:
    """Return the run-time as one C file: this package's sources, with what they include put in once."""
    files = {name: data.decode() for name, data in library.own_files().items()}
    seen: set[str] = set()

    def whole(name: str) -> str:
        if name in seen:
            return ""
        seen.add(name)
        return _INCLUDE.sub(lambda found: whole(found[1]), files[name])

    files[f"{NAME}.c"] = (FOLDER / "source" / f"{NAME}.c").read_text(encoding="utf-8")
    text = "".join(whole(name) for name in (*_FRICTION, f"{NAME}.c"))
    command = f"cc -std=c99 -O2 -ffp-contract=off -fPIC -shared -o {NAME}.so {NAME}.c -lm"
    return f"/* The run-time of a cycloid joint, made of several sources. Compile it: {command} */\n{text}".encode()


@functools.cache
def source_hash() -> str:
    """Return the hash of the source, which a library made of it contains."""
    return hashlib.sha256(source()).hexdigest()


def write_runtime(joint: Joint, folder: str | os.PathLike[str]) -> list[Path]:
    """Write what a simulator needs: the document and its draws, the Python module, the C source and the libraries.

    Raises
    ------
    edge.InputError
        If the run-time refuses the joint, the folder can't be made, or a library is not of the present source.
    """
    place = Path(folder)
    with refused_as_input():
        joint_drive.JointDrive(joint.document, joint_drive.LONGEST_STEP, 0.0)
    try:
        (place / LIBRARIES.name).mkdir(parents=True, exist_ok=True)
    except OSError as problem:
        raise edge.InputError(f"{place}: {problem.strerror or problem}.") from None
    files = {f"{NAME}.py": (FOLDER / f"{NAME}.py").read_bytes(), f"{NAME}.c": source()}
    for path in sorted(LIBRARIES.iterdir()):
        data = path.read_bytes()
        if source_hash().encode() not in data:
            raise edge.InputError(f"{path}: it is not of the present sources; see CONTRIBUTING.md.")
        files[f"{LIBRARIES.name}/{path.name}"] = data
    for name, data in files.items():
        with edge.written_whole(place / name) as temporary:
            temporary.write_bytes(data)
    joint.write(place / "joint.json")
    return [place / name for name in (*files, "joint.json")]
