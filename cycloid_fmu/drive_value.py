"""A drive as one value: its gear pair, its actual errors and its first stage. Every room above takes it."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

from cycloid_fmu.geometry.first_stage import FirstStage
from cycloid_fmu.geometry.pair import Pair
from cycloid_fmu.surfaces.provenance import drive_hash, drive_text
from cycloid_fmu.surfaces.structured import displacements, with_structured
from cycloid_fmu.surfaces.surface import ErrorSurface, at_own_age, surface_of_pair

SLICES_MISALIGNED = 20  # transmission error within 0.1 % to 0.5 mrad, by midpoints (docs/theory/contact.md)


@dataclass(frozen=True, eq=False)
class DriveValue:
    """A gear pair with its actual errors and, of a reducer, its first stage. Immutable, equal by value.

    Nothing is checked here: `cycloid_fmu.Drive` is the checked one, with the functions that compute.

    Attributes
    ----------
    pair
        The gear pair. Its stated errors do not count: those of the drive are the surface's.
    surface
        The drive's errors, without form and wear where the surface has none.
    first_stage
        The involute stage that turns the cranks; None if a motor turns them. With it transmission error, stiffness and
        play are those of the output with the sun locked.
    """

    pair: Pair
    surface: ErrorSurface
    first_stage: FirstStage | None = None

    @classmethod
    def as_stated(cls, pair: Pair, first_stage: FirstStage | None = None) -> Self:
        """Return the drive of a pair with its stated errors."""
        return cls(pair, surface_of_pair(pair), first_stage)

    def __eq__(self, other: object) -> bool:
        return self.hash == other.hash if isinstance(other, DriveValue) else NotImplemented

    def __hash__(self) -> int:
        return hash(self.hash)

    @property
    def ratio(self) -> float:
        """Signed ratio of the input's rotation (crank, or sun of a first stage) to that of the output."""
        return self.pair.ratio if self.first_stage is None else self.first_stage.ratio(self.pair.gear_teeth)

    @property
    def text(self) -> str:
        """The gear pair and its errors as the text of a pair file, the same for equal values.

        Form and wear of elements are not part of it.
        """
        return drive_text(self.pair, self.surface)

    @functools.cached_property
    def hash(self) -> str:
        """Fingerprint of all values, 16 hexadecimal digits: the same for equal drives."""
        return drive_hash(self.pair, self.surface, "" if self.first_stage is None else self.first_stage.text)

    @property
    def provenance(self) -> dict[str, str]:
        """The attributes that every result carries: the drive's text, its fingerprint, and the surface's origin."""
        return {"pair": self.text, "drive": self.hash, "surface": self.surface.origin}

    @functools.cached_property
    def displacements(self) -> Mapping[str, Any]:
        """Displacements of all elements by errors and temperatures, m and rad, by name (`surfaces.structured`)."""
        return displacements(self.pair, self.surface, {})

    @functools.cached_property
    def slices(self) -> int:
        """Slices that the errors need: elements across the width, 20 where the gear's axis is tilted, otherwise 1."""
        tilted = self.displacements["tilt_x"] != 0.0 or self.displacements["tilt_y"] != 0.0
        deviations = (self.surface.gear_deviation, self.surface.pin_deviation)
        elements = [int(d.shape[-1]) for d in deviations if d is not None]
        return max([SLICES_MISALIGNED if tilted else 1, *elements])

    @property
    def at_own_age(self) -> DriveValue:
        """The drive as its surface is now, without a life; with a forecast, with the clearance of this age."""
        pair, surface = at_own_age(self.pair, self.surface)
        return self if surface is self.surface else DriveValue(pair, surface, self.first_stage)

    @property
    def stage(self) -> DriveValue:
        """The cycloid stage alone."""
        return self if self.first_stage is None else DriveValue(self.pair, self.surface)

    def with_surface(self, surface: ErrorSurface) -> DriveValue:
        """Return the same drive with other errors."""
        return DriveValue(self.pair, surface, self.first_stage)

    def with_structured(self, values: Mapping[str, float]) -> DriveValue:
        """Return the same drive with given values, m or rad, of structured errors."""
        return self.with_surface(with_structured(self.surface, values))
