"""Elastic bodies of a drive: discs with their holes, pins, cranks, output pins, carrier and ring, as in `[bodies]`."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self

import pydantic

from cycloid_fmu.edge import Angle, Config, Length
from cycloid_fmu.geometry import sizes


def _near(value: float) -> float:
    if not abs(value) <= _FURTHEST:
        raise ValueError(f"it must be between -{_FURTHEST:g} m and {_FURTHEST:g} m")
    return value


_FURTHEST = 5.0
Coordinate = Annotated[Length, pydantic.AfterValidator(_near)]
SpanLength = sizes.Width
MOST_WINDOWS = 120
LEAST_FACTOR, LARGEST_FACTOR = 1e-3, 1e3
_WINDOW_KEYS = {
    "fan": ("inner_radius", "outer_radius", "half_angle", "corner_radius"),
    "round": ("circle_radius", "radius"),
    "polygon": ("x", "y", "dxf"),
}


class ElasticBody(Config):
    """What every body has: its material, and in place of its dimensions a matrix computed elsewhere.

    Attributes
    ----------
    youngs_modulus
        Young's modulus, Pa; by default that of the gear's material for the disc, of the pin's for the pin, and 206 GPa
        for the others.
    poissons_ratio
        Poisson's ratio; by default that of the same material, and 0.3 for the others.
    matrix
        File of the body's influence matrix, `cycloid-influence/1` (netCDF, or CSV); None to compute it.
    stiffness_factor
        Factor on the stiffness by its dimensions or its matrix, as an identification finds it; None for 1.
    stiffness_uncertainty
        Standard deviation of the logarithm of that factor, about the relative one of the stiffness: an identification
        then fits the stiffness. None if it is as stated.
    """

    DIMENSIONS: ClassVar[tuple[str, ...]] = ()
    """Keys that a body without a matrix needs."""
    youngs_modulus: sizes.PositivePressure | None = None
    poissons_ratio: float | None = pydantic.Field(default=None, ge=0.0, lt=0.5)
    matrix: str | None = None
    stiffness_factor: float | None = pydantic.Field(default=None, ge=LEAST_FACTOR, le=LARGEST_FACTOR)
    stiffness_uncertainty: float | None = pydantic.Field(default=None, gt=0.0, le=2.0)

    @property
    def compliance_factor(self) -> float:
        """Factor on the influence by its dimensions or its matrix."""
        return 1.0 if self.stiffness_factor is None else 1.0 / self.stiffness_factor

    @pydantic.model_validator(mode="after")
    def _stated_once(self) -> Self:
        """Raise a `ValueError` that names the first of the dimensions that is missing without a matrix."""
        missing = [key for key in self.DIMENSIONS if getattr(self, key) is None]
        if missing and self.matrix is None:
            raise ValueError(f"{missing[0]} is missing; state it, or the file of a matrix")
        stated = [key for key in self.DIMENSIONS if getattr(self, key) is not None]
        if stated and self.matrix is not None:
            raise ValueError(f"it is stated by matrix and {stated[0]}; state one of them")
        return self


class Window(Config):
    """Equal windows in a disc, evenly spaced around its centre; they turn with the holes.

    Attributes
    ----------
    shape
        "fan": between two radii and two sides; "round": a circle; "polygon": straight sides.
    count
        Number of windows.
    first_angle
        Angle of the first one's middle from the disc's +x at crank angle 0, rad; it turns a polygon.
    inner_radius
        Inner radius of a fan, m.
    outer_radius
        Its outer radius, m.
    half_angle
        Half of a fan's angle, rad.
    corner_radius
        Radius of a fan's corners, tangent to arc and side, m.
    circle_radius
        Distance of a round window's centre from the disc's, m.
    radius
        Radius of a round window, m.
    x
        x of the corners of a polygon whose middle is about +x, m.
    y
        y of the same corners, m.
    dxf
        DXF file with the polygon, or arcs, as one closed outline about +x, in its unit (mm without one).
    """

    shape: Literal["fan", "round", "polygon"]
    count: int = pydantic.Field(default=1, ge=1, le=MOST_WINDOWS, strict=True)
    first_angle: Angle = 0.0
    inner_radius: sizes.Dimension | None = None
    outer_radius: sizes.Dimension | None = None
    half_angle: Angle | None = None
    corner_radius: sizes.Dimension | None = None
    circle_radius: sizes.Dimension | None = None
    radius: sizes.Dimension | None = None
    x: Annotated[tuple[Coordinate, ...], pydantic.Field(min_length=3)] | None = None
    y: Annotated[tuple[Coordinate, ...], pydantic.Field(min_length=3)] | None = None
    dxf: str | None = None

    @pydantic.model_validator(mode="after")
    def _one_shape(self) -> Window:
        own = _WINDOW_KEYS[self.shape]
        for shape, keys in _WINDOW_KEYS.items():
            alien = [key for key in keys if shape != self.shape and getattr(self, key) is not None]
            if alien:
                raise ValueError(f'{alien[0]} belongs to shape = "{shape}"; "{self.shape}" has {", ".join(own)}')
        needed = own[:3] if self.shape == "fan" else own
        if self.shape == "polygon":
            needed = ("dxf",) if self.dxf is not None else ("x", "y")
        missing = [key for key in needed if getattr(self, key) is None]
        if missing:
            raise ValueError(f'{missing[0]} is missing; shape = "{self.shape}" needs it')
        if self.shape == "polygon":
            self._check_polygon()
        if self.shape == "fan":
            self._check_fan()
        return self

    def _check_polygon(self) -> None:
        if self.dxf is not None and (self.x is not None or self.y is not None):
            raise ValueError("it is stated by dxf and by x and y; state one of them")
        if self.x is not None and self.y is not None and len(self.x) != len(self.y):
            raise ValueError(f"x has {len(self.x)} values and y {len(self.y)}; each corner has both")

    def _check_fan(self) -> None:
        import math

        inner, outer, half = self.inner_radius, self.outer_radius, self.half_angle
        assert inner is not None
        assert outer is not None
        assert half is not None
        if not inner < outer:
            raise ValueError(f"inner_radius is {_mm(inner)} and outer_radius {_mm(outer)}; the outer must be larger")
        if not 0.0 < half < math.pi / self.count:
            raise ValueError(
                f"half_angle is {math.degrees(half):.6g} deg; {self.count} windows side by side leave less than "
                f"{180.0 / self.count:.6g} deg"
            )
        corner = self.corner_radius or 0.0
        sine = math.sin(min(half, 0.5 * math.pi))
        most = min(0.5 * (outer - inner), inner * sine / (1.0 - sine) if sine < 1.0 else math.inf)
        if corner > 0.999 * most:
            raise ValueError(f"corner_radius is {_mm(corner)}; it must be below {_mm(most)}, or the corners overlap")


class DiscBody(ElasticBody):
    """A cycloid disc: its outline is the nominal flank without modification, its thickness the face width.

    Attributes
    ----------
    matrix
        File of its influence matrix; a list of files for several discs. None to compute it.
    plane
        "stress": free faces; "strain": no strain along the axis, the other bound.
    bore_radius
        Radius of the bores of the turning-arm bearings, m; with output rollers of the one of the eccentric's bearing.
    centre_radius
        Radius of a hole in the middle, m; only with cranks.
    roller_hole_radius
        Radius of the holes of the output rollers, m; only with output rollers.
    windows
        Further holes.
    """

    DIMENSIONS = ("bore_radius",)
    matrix: str | Annotated[tuple[str, ...], pydantic.Field(min_length=1)] | None = None  # type: ignore[assignment]
    plane: Literal["stress", "strain"] = "stress"
    bore_radius: sizes.Dimension | None = None
    centre_radius: sizes.Dimension | None = None
    roller_hole_radius: sizes.Dimension | None = None
    windows: tuple[Window, ...] = pydantic.Field(default=(), max_length=MOST_WINDOWS)

    @property
    def matrices(self) -> tuple[str, ...]:
        """The names of its files, one for each disc; empty if they are computed."""
        return (self.matrix,) if isinstance(self.matrix, str) else self.matrix or ()

    @pydantic.model_validator(mode="after")
    def _dimensions(self) -> DiscBody:
        for name in ("centre_radius", "roller_hole_radius", "windows"):
            if self.matrix is not None and getattr(self, name):
                raise ValueError(f"it is stated by matrix and {name}; state one of them")
        return self


class PinBody(ElasticBody):
    """A pin of the ring, which bends between its ends.

    Attributes
    ----------
    ends
        "supported" or "clamped", at half the span on either side of the middle of the discs.
    span
        Distance of its ends, m.
    diameter
        Its diameter, m; None for twice the pin radius.
    """

    DIMENSIONS = ("ends", "span")
    ends: Literal["supported", "clamped"] | None = None
    span: SpanLength | None = None
    diameter: sizes.Dimension | None = None


class Section(Config):
    """A piece of a shaft with one diameter.

    Attributes
    ----------
    start
        Its beginning from the middle of the discs, along the axis, m; `from` in a file.
    end
        Its end from there, m; `to` in a file.
    diameter
        Its diameter, m.
    """

    model_config = pydantic.ConfigDict(populate_by_name=True)

    start: Coordinate = pydantic.Field(alias="from")
    end: Coordinate = pydantic.Field(alias="to")
    diameter: sizes.Dimension

    @pydantic.model_validator(mode="after")
    def _has_length(self) -> Section:
        if not self.start < self.end:
            raise ValueError(f"from is {_mm(self.start)} and to {_mm(self.end)}; to must be larger")
        return self


class CrankBody(ElasticBody):
    """A crank shaft on its two bearings; with output rollers the central one.

    Attributes
    ----------
    bearings
        Places of both bearings from the middle of the discs, along the axis, m.
    sections
        Pieces of the shaft, without gaps, from the first bearing or disc to the last.
    """

    DIMENSIONS = ("bearings", "sections")
    bearings: tuple[Coordinate, Coordinate] | None = None
    sections: Annotated[tuple[Section, ...], pydantic.Field(min_length=1, max_length=100)] | None = None

    @pydantic.model_validator(mode="after")
    def _dimensions(self) -> CrankBody:
        if self.bearings is not None and not self.bearings[0] < self.bearings[1]:
            first, second = self.bearings
            raise ValueError(f"bearings are at {_mm(first)} and {_mm(second)}; the second must be further along +z")
        for before, after in zip(self.sections or (), (self.sections or ())[1:], strict=False):
            if abs(after.start - before.end) > 1e-9:
                raise ValueError(f"a section ends at {_mm(before.end)} and the next begins at {_mm(after.start)}")
        return self


class OutputPinBody(ElasticBody):
    """A pin of the carrier that bears an output roller.

    Attributes
    ----------
    ends
        "cantilever": clamped at `from` alone; "clamped": at both ends.
    start
        Its beginning from the middle of the discs, along the axis, m; `from` in a file.
    end
        Its end from there, m; `to` in a file.
    diameter
        Its diameter, m.
    """

    model_config = pydantic.ConfigDict(populate_by_name=True)

    DIMENSIONS = ("ends", "start", "end", "diameter")
    ends: Literal["cantilever", "clamped"] | None = None
    start: Coordinate | None = pydantic.Field(default=None, alias="from")
    end: Coordinate | None = pydantic.Field(default=None, alias="to")
    diameter: sizes.Dimension | None = None

    @pydantic.model_validator(mode="after")
    def _dimensions(self) -> OutputPinBody:
        if self.start is not None and self.start == self.end:
            raise ValueError(f"from and to are both {_mm(self.start)}; they must differ")
        return self


class CarrierBody(ElasticBody):
    """A carrier of two rigid plates, joined by columns that are clamped to both; the output is one plate.

    Attributes
    ----------
    columns
        Number of columns.
    circle_radius
        Radius of their circle, m.
    length
        Length of a column between the plates, m.
    radial_width
        Side of a column's rectangular section along the radius, m.
    tangential_width
        Its side along the tangent, m.
    share
        Share of each crank's load that is on the plate which is not the output, 0 to 1.
    """

    DIMENSIONS = ("columns", "circle_radius", "length", "radial_width", "tangential_width", "share")
    columns: int | None = pydantic.Field(default=None, ge=2, le=40, strict=True)
    circle_radius: sizes.CircleRadius | None = None
    length: SpanLength | None = None
    radial_width: sizes.Dimension | None = None
    tangential_width: sizes.Dimension | None = None
    share: float | None = pydantic.Field(default=None, ge=0.0, le=1.0)


class RingBody(ElasticBody):
    """The ring as an annulus around the pin circle, its outer surface held by the housing.

    Attributes
    ----------
    outer_radius
        Its outer radius, m.
    width
        Its width along the axis, m.
    """

    DIMENSIONS = ("outer_radius", "width")
    outer_radius: sizes.CircleRadius | None = None
    width: SpanLength | None = None


class Bodies(Config):
    """Elastic bodies of a drive (docs/theory/bodies.md); a body that is not stated is rigid.

    Attributes
    ----------
    disc_spacing
        Distance of the middle planes of neighbouring discs along the axis, m; None for the face width.
    disc
        The discs.
    pin
        The pins of the ring, if they bend.
    crank
        The crank shafts, or with output rollers the central one.
    output_pin
        The pins of the output rollers; only with output rollers.
    carrier
        The carrier; only with cranks.
    ring
        The ring.

    Examples
    --------
    >>> from cycloid_fmu.geometry.bodies import Bodies
    >>> bodies = Bodies(disc={"bore_radius": "12.5 mm"}, ring={"outer_radius": "62 mm", "width": "24 mm"})
    >>> bodies.disc.plane, bodies.ring.outer_radius
    ('stress', 0.062)
    """

    disc_spacing: sizes.Dimension | None = None
    disc: DiscBody | None = None
    pin: PinBody | None = None
    crank: CrankBody | None = None
    output_pin: OutputPinBody | None = None
    carrier: CarrierBody | None = None
    ring: RingBody | None = None

    def stated(self) -> Iterator[tuple[str, ElasticBody]]:
        """Yield each body that is not rigid, with its key in `[bodies]`."""
        for name in type(self).model_fields:
            if isinstance(body := getattr(self, name), ElasticBody):
                yield name, body

    def with_factors(self, factors: Mapping[str, float | None]) -> Bodies:
        """Return the bodies with other stiffness factors, by the bodies' keys."""
        return self.replace(
            **{name: getattr(self, name).replace(stiffness_factor=factor) for name, factor in factors.items()}
        )

    def of_files(self, files: Mapping[str, Sequence[str]]) -> Bodies:
        """Return the same bodies by the files of their matrices, under their keys in `[bodies]`."""
        kinds = {name: type(body) for name, body in self.stated()}
        return Bodies(**{n: kinds[n](matrix=each[0] if len(each) == 1 else tuple(each)) for n, each in files.items()})

    def in_folder(self, folder: Path) -> Bodies:
        """Return the bodies of a file in a folder with the names of their files as seen from the working folder."""
        return self._with_files(lambda name: os.path.normpath(folder / name))

    def seen_from(self, folder: Path) -> Bodies:
        """Return the bodies with the names of their files, unless absolute, as seen from a folder: of `in_folder`."""
        return self._with_files(lambda name: name if Path(name).is_absolute() else os.path.relpath(name, folder))

    def _with_files(self, renamed: Callable[[str], str]) -> Bodies:
        changes: dict[str, Any] = {
            name: body.replace(matrix=renamed(body.matrix))
            for name, body in self.stated()
            if isinstance(body.matrix, str)
        }
        if self.disc is not None and len(self.disc.matrices) > 1:
            changes["disc"] = self.disc.replace(matrix=tuple(map(renamed, self.disc.matrices)))
        if self.disc is not None and any(window.dxf for window in self.disc.windows):
            windows = tuple(w.replace(dxf=renamed(w.dxf)) if w.dxf else w for w in self.disc.windows)
            changes["disc"] = self.disc.replace(windows=windows)
        return self.replace(**changes)


def _mm(value: float) -> str:
    return f"{value * 1e3:.6g} mm"
