"""The joint document `cycloid-joint/1`: what a robot simulator needs to know of a drive, each number with its origin.

A joint has its numbers by dotted names, `friction.motor.coulomb` or `te_orders.0.phase`; `joint_drive` states and
checks them.
"""

from __future__ import annotations

import contextlib
import csv
import dataclasses
import io
import json
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from cycloid_fmu import edge
from cycloid_fmu.joint import joint_drive

Number = dict[str, Any]
DRAWS = "draws.csv"


def number(value: float, origin: str, interval: tuple[float, float] | None = None) -> Number:
    """Return a known number, SI; `interval` is that of 95 %."""
    low_high = None if interval is None else [float(interval[0]), float(interval[1])]
    return {"value": float(value), "interval": low_high, "origin": origin}


def unknown(reason: str) -> Number:
    """Return an unknown number."""
    return {"value": None, "reason": reason}


@dataclasses.dataclass(frozen=True)
class Joint:
    """A drive as a joint of a robot simulator.

    Attributes
    ----------
    numbers
        Each number by its dotted name: `{"value", "interval", "origin"}` with SI units and the interval of 95 %, or
        `{"value": None, "reason"}`.
    rows
        Draws: values by dotted name. The first row has the document's own values.
    source
        Of what it is: hash of the drive, files, torque of the transmission error.
    not_represented
        What the numbers leave out, one sentence each.

    Examples
    --------
    >>> import cycloid_fmu as cy
    >>> pair = cy.Pair(
    ...     gear_teeth=39, pin_circle_radius="64 mm", pin_radius="3 mm", eccentricity="1.3 mm", face_width="10 mm",
    ...     rated_torque="181 N*m",
    ... )
    >>> joint = cy.Drive(pair).replace(offset="-20 um").joint(stated={"rotor_inertia": "1e-4 kg*m^2"}, angles=90)
    >>> joint.numbers["ratio"]["value"], joint.numbers["friction.motor.coulomb"]["reason"]
    (-39.0, 'the pair states no [losses]')
    >>> joint.write("joint.json")
    """

    numbers: Mapping[str, Number]
    rows: tuple[Mapping[str, float], ...] = ()
    source: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    not_represented: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        with refused_as_input():
            joint_drive.check(self.values, str(self.source.get("file", "joint")))

    @property
    def values(self) -> dict[str, float | None]:
        """Values by dotted name, None where unknown."""
        return {name: each["value"] for name, each in self.numbers.items()}

    @property
    def document(self) -> dict[str, Any]:
        """The document as JSON has it."""
        content: dict[str, Any] = {"format": joint_drive.FORMAT}
        for name in (*joint_drive.SCALARS, *joint_drive.LISTS):
            *places, last = name.split(".")
            table = content
            for place in places:
                table = table.setdefault(place, {})
            table[last] = self.numbers.get(name) or self._rows(name)
        draws = DRAWS if self.rows else None
        return content | {
            "source": dict(self.source),
            "draws": draws,
            "not_represented": list(self.not_represented),
        }

    def _rows(self, name: str) -> list[dict[str, Number]]:
        members, rows = joint_drive.LISTS[name], list[dict[str, Number]]()
        while f"{name}.{len(rows)}.{members[0]}" in self.numbers:
            rows.append({member: self.numbers[f"{name}.{len(rows)}.{member}"] for member in members})
        return rows

    def draws_text(self) -> str:
        """Return the draws as CSV, SI, with a header of dotted names."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(self.rows[0])
        writer.writerows([repr(float(value)) for value in row.values()] for row in self.rows)
        return text.getvalue()

    def row(self, number: int) -> dict[str, float | None]:
        """Return the values with those of a row of the draws.

        Raises
        ------
        edge.InputError
            If there is no such row.
        """
        if not 0 <= number < len(self.rows):
            raise edge.ArgumentError("row", f"the joint has {len(self.rows)} draws", number)
        return {**self.values, **self.rows[number]}

    def write(self, path: str | os.PathLike[str]) -> None:
        """Write the document (`.json`) and, if there are draws, `draws.csv` in the same folder.

        Raises
        ------
        edge.InputError
            If the name has another ending, or can't be written.
        """
        target = edge.output_path(path, "path", (".json",))
        if self.rows:
            with edge.written_whole(target.with_name(DRAWS)) as temporary:
                temporary.write_text(self.draws_text(), encoding="utf-8")
        with edge.written_whole(target) as temporary:
            temporary.write_text(edge.json_text(self.document), encoding="utf-8")


@contextlib.contextmanager
def refused_as_input() -> Iterator[None]:
    """Context in which a refusal of the run-time is an `edge.InputError`."""
    try:
        yield
    except joint_drive.JointError as problem:
        raise edge.InputError(str(problem)) from None


def read_joint(path: str | os.PathLike[str]) -> Joint:
    """Return the joint of a document, with its draws.

    Raises
    ------
    edge.InputError
        If the file can't be read, or a number is missing or out of range.
    """
    content = edge.json_table(path, joint_drive.FORMAT, "a joint document")
    with refused_as_input():
        numbers = joint_drive.flat(content, str(path))
    with refused_as_input():
        rows = joint_drive.rows_of(Path(path).parent / content["draws"], numbers) if content.get("draws") else []
    source = {"file": str(path), **content.get("source", {})}
    return Joint(numbers, tuple(rows), source, tuple(content.get("not_represented", ())))


def json_of(joint: Joint) -> str:
    """Return the document in one line, as a script contains it."""
    return json.dumps(joint.document, ensure_ascii=False)
