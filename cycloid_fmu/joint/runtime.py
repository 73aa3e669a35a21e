"""The run-time of a joint as files: one C source, the libraries made of it, and the Python module that loads them."""

from __future__ import annotations

import functools
import hashlib
import re
from pathlib import Path

from cycloid_fmu.fmu import library

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
