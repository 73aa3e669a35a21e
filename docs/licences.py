"""The page of licences: of every package that this one and its extras for users ask for, from what is installed."""

import re
from importlib import metadata
from pathlib import Path

from packaging.requirements import Requirement

OURS = {"docs", "measure", "test"}  # extras for development
# SPDX names of licences that packages state in words. The Python Package Index does not state which BSD licence it is.
SPDX = {
    "Apache License 2.0": "Apache-2.0",
    "Apache Software License": "Apache-2.0",
    "BSD License": "BSD-3-Clause",
    "BSD": "BSD-3-Clause",
    "3-Clause BSD License": "BSD-3-Clause",
    "ISC License (ISCL)": "ISC",
    "MIT License": "MIT",
    "GNU Lesser General Public License v3 (LGPLv3)": "LGPL-3.0-only",
    "Apache": "Apache-2.0",
    "BSD-3": "BSD-3-Clause",
    "GNU Lesser General Public License v3 or later (LGPLv3+)": "LGPL-3.0-or-later",
    "PSF": "PSF-2.0",
    "Mozilla Public License 2.0 (MPL 2.0)": "MPL-2.0",
    "Python Software Foundation License": "PSF-2.0",
}
STATED = {
    "fmpy": "BSD-2-Clause",  # by the licence file alone
    # The binding states Apache-2.0; the wheel contains Open CASCADE as well.
    "cadquery-ocp-novtk": "Apache-2.0 AND LGPL-2.1-only WITH OCCT-exception-1.0",
}
# Anything may be built on these, as long as packages under LGPL or MPL stay packages of their own that can be replaced.
ALLOWED = {
    "0BSD",
    "Apache-2.0",
    "BSD-2-Clause",
    "BSD-3-Clause",
    "CC0-1.0",
    "ISC",
    "LGPL-2.1-only",
    "LGPL-3.0-only",
    "LGPL-3.0-or-later",
    "LLVM-exception",
    "MIT",
    "MIT-CMU",
    "MPL-2.0",
    "OCCT-exception-1.0",
    "PSF-2.0",
    "Zlib",
}
HEAD = """# Licences

cycloid-fmu is under the MIT licence. These are the packages that it and its extras for users install on Linux, with the
licence that each package states ([SPDX](https://spdx.org/licenses/)); `python docs/licences.py` writes this page
from the installed packages.

`constraints.txt` has the versions that are tested together: `pip install -c constraints.txt cycloid-fmu`. A bill of
materials of an environment ([CycloneDX](https://cyclonedx.org), JSON), with the extra `test`:
`python -m cyclonedx_py environment --pyproject pyproject.toml -o sbom.json`.

The compiled libraries in the package (`cycloid_fmu/fmu/libraries`, `cycloid_fmu/fmu/front`,
`cycloid_fmu/joint/libraries`) are made from its own sources, those of FMUs also from the FMI standard's headers
(BSD-2-Clause), with parts of the runtime of zig, their compiler (MIT). A native FMU contains the licence texts.

| package | licence | needed by |
| --- | --- | --- |
"""


def licence(name: str) -> str:
    """Return the licence that an installed package states, as an SPDX expression where its words are known."""
    if name in STATED:
        return STATED[name]
    said = metadata.metadata(name)
    classified = [c.rpartition(" :: ")[2] for c in said.get_all("Classifier", []) if c.startswith("License :: OSI")]
    words = (
        said.get("License-Expression")
        or " AND ".join(sorted(SPDX.get(c, c) for c in classified))
        or said.get("License")
        or ""
    )
    first = words.strip().splitlines()[0] if words.strip() else ""
    return SPDX.get(first, first)


def parts(expression: str) -> set[str]:
    """Return the licences in an SPDX expression."""
    return {word for word in re.split(r"[\s()]+|\b(?:AND|OR|WITH)\b", expression) if word}


def needed() -> dict[str, str]:
    """Return all packages by their normalised names, and the extra that asks for each, "" where none must."""
    found: dict[str, str] = {}

    def add(requirements: list[str], extra: str, asked: frozenset[str]) -> None:
        for requirement in map(Requirement, requirements):
            name = re.sub(r"[-_.]+", "-", requirement.name).lower()
            marks = requirement.marker
            if name == "cycloid-fmu" or (marks and not any(marks.evaluate({"extra": one}) for one in asked)):
                continue
            if (name, *sorted(requirement.extras)) in seen:
                continue
            seen.add((name, *sorted(requirement.extras)))
            found.setdefault(name, extra)
            add(metadata.requires(name) or [], extra, frozenset({"", *requirement.extras}))

    own = metadata.requires("cycloid-fmu") or []
    seen: set[tuple[str, ...]] = set()
    add(own, "", frozenset({""}))
    for extra in sorted({*metadata.metadata("cycloid-fmu").get_all("Provides-Extra", [])} - OURS):
        add([one for one in own if "extra ==" in one], extra, frozenset({extra}))
    return dict(sorted(found.items()))


def page() -> str:
    """Return the page."""
    rows = (f"| {name} | {licence(name)} | {extra or 'cycloid-fmu'} |\n" for name, extra in needed().items())
    return HEAD + "".join(rows)


if __name__ == "__main__":
    Path(__file__).with_suffix(".md").write_text(page(), encoding="utf-8")
