"""From a wish to a first drive: ratio, outer diameter, torque, material and process.

Sizes follow rules that are stated with each value; modification and face width are those of `design.search`, for the
least backlash at which drives of the process turn freely, and for the least width that the weaker material carries.
The face width grows where the drive on its bearings needs more, with its elastic bodies if it has them.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
import os
from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
import pydantic
from numpy.typing import NDArray

from cycloid_fmu import edge
from cycloid_fmu.analysis import solve
from cycloid_fmu.analysis.validity import out_of_step
from cycloid_fmu.contact.transmission import Transmission, UnbalancedError
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.geometry import CRANK_SPEED, sizes
from cycloid_fmu.geometry.bodies import Bodies
from cycloid_fmu.geometry.losses import Losses
from cycloid_fmu.geometry.materials import MATERIALS
from cycloid_fmu.geometry.pair import LEAST_TEETH, MOST_TEETH, Pair, PositiveTorque, smallest_convex_radius
from cycloid_fmu.geometry.processes import PROCESSES, Process, standard_tolerance
from cycloid_fmu.geometry.supports import OutputRoller, Supports
from cycloid_fmu.studies.design import DesignTask, search
from cycloid_fmu.studies.tolerance import Study, exact_figures, points, surface_of
from cycloid_fmu.supports.figures import bearing_loads
from cycloid_fmu.surfaces.sampling import Tolerances, parse_tolerances
from cycloid_fmu.surfaces.surface import surface_of_pair

Array = NDArray[np.float64]
_DOWELS = (1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0, 12.0, 16.0, 20.0)  # mm, ISO 8734
_BALL_BEARINGS = (  # bore, outside diameter, width (mm), C (kN): SKF, deep groove, series 618
    (10.0, 19.0, 5.0, 1.38),
    (12.0, 21.0, 5.0, 1.43),
    (15.0, 24.0, 5.0, 1.56),
    (17.0, 26.0, 5.0, 1.68),
    (20.0, 32.0, 7.0, 4.03),
    (25.0, 37.0, 7.0, 4.36),
    (30.0, 42.0, 7.0, 4.49),
    (35.0, 47.0, 7.0, 4.36),
    (40.0, 52.0, 7.0, 4.49),
    (45.0, 58.0, 7.0, 6.63),
    (50.0, 65.0, 7.0, 6.76),
    (55.0, 72.0, 9.0, 9.04),
    (60.0, 78.0, 10.0, 11.9),
    (65.0, 85.0, 10.0, 12.4),
    (70.0, 90.0, 10.0, 12.4),
    (75.0, 95.0, 10.0, 12.7),
    (80.0, 100.0, 10.0, 13.0),
)
_SHORTENING = 0.65  # K = e z_p/R_p: lower, forces on the crank grow; higher, the flank's tips get sharp
_PIN_SHARE = 0.45  # largest diameter of a pin relative to the distance of neighbouring pins
_CURVATURE = 1.3  # least curvature radius of the pin centre's path relative to the pin's radius: no sharp flank
_MODIFICATION = 4.0  # range of the modification relative to the tolerance of a position
_USUAL_CLEARANCE = 1.1  # isometric modification that a search ends with, relative to the tolerance of a position
_YIELD = 0.95  # of drives of the process that must turn freely
_SAMPLES, _JUDGED = 64, 128  # drives of each round of the search, and of those that decide
_SEED, _ANGLES = 2, 90  # of these; crank angles at least
_STEP = 0.02  # step of the clearance relative to its range
_LARGEST_WIDTH = 0.3  # of all discs together relative to the outer diameter
_LEAST_WIDTH = 2e-3  # m
_GAP = 0.5e-3  # m, between discs and beside them
_OUTPUT_PINS = ((6, 8, 5, 4), (10, 12))  # numbers in the order of preference; many small ones only if few do not fit
_TRIALS = 5  # doublings or quarterings of a value, and bisections, for the nearest possible drive
_LEVERS = (  # what may be changed for that, its unit and what it is of, shown unit per SI unit, factor of a trial
    ("outer_diameter", "mm of outer diameter", 1e3, 2.0),
    ("torque", "N*m of torque", 1.0, 0.25),
    ("length", "mm of length", 1e3, 2.0),
    ("life", "h of life", 1.0 / 3600.0, 0.25),
)
_ADAPTED = 8  # times that face width and eccentric bearing are adapted to the drive on its bearings
_SAFETY = 1.5  # of output pins against bending fatigue
_PIN_STEEL = "bearing steel"
_OUTPUT_STEEL = "case-hardened steel"
_AS_WIDE = "as wide as the eccentric bearing"
_SHEAR = 30e6  # Pa: of the crank, as in handbooks for shafts whose bending is not known yet
_BEARING_SPEED, _BEARING_LOAD = 2.0, 0.0007  # f_0 and f_1 of deep groove bearings with grease (Palmgren)


class Wish(edge.Arguments):
    """What a drive shall be.

    Attributes
    ----------
    ratio
        Whole number, |motor speed/output speed|.
    outer_diameter
        Largest diameter of the ring, m.
    torque
        Rated torque at the output, N·m.
    material
        Of discs, a name of `materials.MATERIALS`.
    pin_material
        Of the pins, None for bearing steel; not with ring = "conjugate". Output pins are of case-hardened steel.
    ring
        "pins": dowels in the ring; "conjugate": a ring in one piece with arcs of the discs' material in place of pins.
    process
        By which discs and ring are made, a name of `processes.PROCESSES`.
    discs
        Number of discs.
    output
        "gear": the carrier turns; "ring": the ring does.
    length
        Most that the discs may take along the axis with 0.5 mm between and beside them, m; None for no limit.
    life
        Least L10 life of the eccentric bearing at the rated torque and `crank_speed`, s; None for any.
    crank_speed
        Speed of the crank, rad/s.
    bodies
        Whether discs, output pins and ring are elastic in the drive.

    Examples
    --------
    >>> from cycloid_fmu.studies.sizing import Wish
    >>> wish = Wish(ratio=15, outer_diameter="70 mm", torque="20 N*m", material="printed PLA", process="FDM")
    >>> wish.gear_teeth
    15
    """

    ratio: int = pydantic.Field(strict=True)
    outer_diameter: sizes.CircleRadius
    torque: PositiveTorque
    material: str
    process: str
    pin_material: str | None = None
    ring: Literal["pins", "conjugate"] = "pins"
    discs: int = pydantic.Field(default=2, ge=1, le=4, strict=True)
    output: Literal["gear", "ring"] = "gear"
    length: sizes.Width | None = None
    life: Annotated[edge.Seconds, pydantic.Field(gt=0.0)] | None = None
    crank_speed: Annotated[edge.Speed, pydantic.Field(gt=0.0)] = CRANK_SPEED
    bodies: bool = pydantic.Field(default=False, strict=True)

    @pydantic.field_validator("material", "pin_material")
    @classmethod
    def _material(cls, name: str | None) -> str | None:
        if name is not None:
            edge.check_named(name, MATERIALS)
        return name

    @pydantic.field_validator("process")
    @classmethod
    def _process(cls, name: str) -> str:
        edge.check_named(name, PROCESSES)
        return name

    @pydantic.model_validator(mode="after")
    def _possible(self) -> Wish:
        least, most = (teeth + (self.output == "ring") for teeth in (LEAST_TEETH, MOST_TEETH))
        if not least <= abs(self.ratio) <= most:
            said = f"one stage with the {self.output} as output has a ratio from {least} to {most}"
            more = "; a larger one needs a first stage before it" if abs(self.ratio) > most else ""
            raise edge.ArgumentError("ratio", said + more, self.ratio)
        if self.pin_material is not None and self.ring == "conjugate":
            said = "a conjugate ring has arcs of the discs' material in place of pins"
            raise edge.ArgumentError("pin_material", said, self.pin_material)
        for name in ("bodies", "life"):
            if getattr(self, name) and self.output == "ring":
                raise edge.ArgumentError(name, "needs bearings, which a drive with the ring as output does not have")
        return self

    @property
    def gear_teeth(self) -> int:
        """Teeth of the discs: the ratio with the gear as output, one less with the ring."""
        return abs(self.ratio) - (self.output == "ring")

    @property
    def crank_turns(self) -> float:
        """Crank turns of the stated life; 0 without."""
        return 0.0 if self.life is None else self.life * self.crank_speed / (2.0 * math.pi)

    @property
    def material_of_pins(self) -> str:
        """Material of the pins, or of the arcs in their place."""
        return self.material if self.ring == "conjugate" else self.pin_material or _PIN_STEEL


@dataclasses.dataclass(frozen=True)
class Sizing:
    """A first drive for a wish.

    Attributes
    ----------
    wish
        The wish.
    pair
        The drive.
    tolerances
        Text of a tolerance file: what the process holds.
    reasons
        {"table.key" of the pair file: why this value}.
    notes
        What is assumed, rigid or not judged, one sentence each.
    bodies
        Its discs, output pins and ring as elastic bodies, whether or not they are so in `pair`; None where output and
        bearings are not sized.
    contact_stiffness
        Of an output pin in its hole, N/m: with elastic bodies, which have the bending, in place of both.
    """

    wish: Wish
    pair: Pair
    tolerances: str
    reasons: dict[str, str]
    notes: tuple[str, ...]
    bodies: Bodies | None = None
    contact_stiffness: float = math.nan

    @property
    def text(self) -> str:
        """The pair file, with the reason of each value behind it."""
        title, *lines = self.pair.text.splitlines()
        wish = self.wish
        head = (
            f"# |ratio| {abs(wish.ratio)}, {wish.outer_diameter * 1e3:g} mm outside, {wish.torque:g} N*m; discs of "
            f"{wish.material} by {wish.process}, {'arcs' if wish.ring == 'conjugate' else 'pins'} of "
            f"{wish.material_of_pins}."
        )
        table, by_name, found = "", False, [head, *(f"# {note}" for note in self.notes), title]
        for line in lines:
            if by_name and line.startswith(("friction_coefficient = ", "static_friction_coefficient = ")):
                continue  # the name states them, without the digits of a geometric mean
            by_name = line.startswith("friction = ") or (by_name and not line.startswith("["))
            if line.startswith("["):
                table = line.strip("[]")
                reason = self.reasons.get(table)
            else:
                reason = self.reasons.get(f"{table}.{line.split(' = ')[0]}")
            found.append(f"{line}  # {reason}" if reason else line)
        if self.bodies is not None and self.pair.bodies is None:
            stiffness = f'"{self.contact_stiffness * 1e-6:.3g} N/um"'
            found.append(
                f"# Elastic bodies; with them [supports.output_roller] stiffness = {stiffness}, the contact alone."
            )
            elastic = self.pair.replace(bodies=self.bodies).text.splitlines()
            first = elastic.index("[bodies]")
            last = next((k for k in range(first, len(elastic)) if elastic[k].startswith("[losses")), len(elastic))
            found += [f"# {line}" for line in elastic[first:last]]
        return "\n".join(found) + "\n"


class _Mesh(NamedTuple):
    """Ring and discs by rules: pin circle and pin radius, eccentricity, m."""

    circle: float
    pin: float
    eccentricity: float


def _mesh(wish: Wish, process: Process) -> _Mesh:
    """Return pin circle, pins and eccentricity for an outer diameter.

    Raises
    ------
    edge.InputError
        If no pin of a standard diameter fits.
    """
    pins, wall = wish.gear_teeth + 1, process.wall
    for diameter in sorted(_DOWELS, reverse=True):
        radius = 0.5e-3 * diameter
        circle = math.floor(2e3 * (0.5 * wish.outer_diameter - wall - radius) + 1e-6) * 0.5e-3
        if circle <= 0.0 or 2.0 * radius > _PIN_SHARE * 2.0 * circle * math.sin(math.pi / pins):
            continue
        step = 0.05e-3 if circle * _SHORTENING / pins > 0.5e-3 else 0.01e-3
        eccentricity = step * math.floor(_SHORTENING * circle / pins / step)
        if eccentricity > 0.0 and smallest_convex_radius(circle, eccentricity, pins) >= _CURVATURE * radius:
            return _Mesh(circle, radius, round(eccentricity, 9))
    problem = f"no pin of {_DOWELS[0]:g} mm or more fits {pins} times inside"
    raise _ImpossibleError("outer_diameter", problem, wish.outer_diameter)


class _ImpossibleError(edge.ArgumentError):
    """A value of a wish for which there is no drive."""


def process_tolerances(wish: Wish, mesh: _Mesh) -> str:
    """Return the text of the tolerance file of drives that a process makes: ISO 286-1 by its grade."""
    process = PROCESSES[wish.process]
    place = process.position(2.0 * mesh.circle)
    flank = process.position(2.0 * mesh.pin)

    def um(value: float) -> str:
        return f'"{value * 1e6:.2g} um"'

    rows = [f"[{key}]\nsingle = {um(place)}\ncumulative = {um(2.0 * place)}" for key in ("gear_pitch", "pin_pitch")]
    each = flank if wish.ring == "conjugate" else standard_tolerance(6, 2.0 * mesh.pin) / 4.0
    for key, value in {
        "pin_radius_each": each,
        "centre_distance_x": place,
        "centre_distance_y": place,
        "eccentricity": process.position(2.0 * mesh.eccentricity),
        "isometric": flank,
    }.items():
        rows.append(f"[{key}]\ntolerance = {um(value)}")
    head = f"# What {wish.process} holds: IT{process.grade} of ISO 286-1 ({process.source})"
    head += ".\n" if wish.ring == "conjugate" else "; pins m6 (ISO 8734).\n"
    return head + 'format = "cycloid-tolerances/1"\n' + "\n".join(rows) + "\n"


def size(wish: Wish, progress: Callable[[str], None] = lambda step: None) -> Sizing:
    """Return a first drive for a wish.

    Parameters
    ----------
    wish
        What the drive shall be.
    progress
        Called with the name of each stage.

    Raises
    ------
    edge.ArgumentError
        If there is none; the sentence names the nearest values of the wish that are possible, each by itself.

    Examples
    --------
    >>> from cycloid_fmu.studies.sizing import Wish, size
    >>> wish = Wish(ratio=15, outer_diameter="70 mm", torque="20 N*m", material="7075-T6", process="CNC")
    >>> drive = size(wish)
    >>> drive.pair.gear_teeth, drive.pair.supports.kind
    (15, 'output_rollers')
    """
    try:
        return _sized(wish, progress)
    except _ImpossibleError as problem:
        impossible: edge.ArgumentError = problem
    except UnbalancedError:
        impossible = edge.ArgumentError("torque", "no contacts that fit can balance it", wish.torque)
    raise edge.ArgumentError(
        impossible.argument, f"{impossible.problem}; {_nearest(wish, progress)}", impossible.value
    ) from None


def _sized(wish: Wish, progress: Callable[[str], None], search_modification: bool = True) -> Sizing:
    process, mesh = PROCESSES[wish.process], _mesh(wish, PROCESSES[wish.process])
    tolerances = process_tolerances(wish, mesh)
    width = min(max(_LEAST_WIDTH, process.wall, 0.5 * _LARGEST_WIDTH * wish.outer_diameter / wish.discs), _widest(wish))
    pair = Pair(
        gear_teeth=wish.gear_teeth,
        pin_circle_radius=mesh.circle,
        pin_radius=mesh.pin,
        eccentricity=mesh.eccentricity,
        face_width=width,
        discs=wish.discs,
        output=wish.output,
        rated_torque=wish.torque,
        material={
            "gear": {"name": wish.material},
            "pin": {"name": wish.material_of_pins},
            "output_pin": {"name": _OUTPUT_STEEL} if wish.output == "gear" else None,
            "ring": {"name": wish.material},
        },
    )
    pair = _modified(pair, wish, tolerances, progress, search_modification)
    limit = pair.largest_pressure
    assert limit is not None
    pair, binding = _wide_enough(pair, wish, process, limit.pressure, progress)
    reasons, notes = _reasons(wish, pair, binding), _notes(wish)
    if wish.output == "gear":
        progress("output and bearings")
        output, pair = _held(wish, pair, process, limit.pressure)
        reasons |= output.reasons
        if pair.face_width == output.bearing_width:
            reasons["pair.face_width"] = _AS_WIDE
        notes += output.notes
        if wish.bodies:
            reasons["supports.output_roller"] = "contact alone, because the output pins bend as bodies"
        bodies = _bodies(wish, pair, output)
        return Sizing(wish, pair, tolerances, reasons, tuple(notes), bodies, output.contact_stiffness)
    notes.append('output = "ring": bearings and output are not modelled, so neither sized here; no losses.')
    return Sizing(wish, pair, tolerances, reasons, tuple(notes))


def _reasons(wish: Wish, pair: Pair, binding: str) -> dict[str, str]:
    """Return the reason of each value of ring and discs; `binding` is that of the face width."""
    wall, pin = (
        PROCESSES[wish.process].wall,
        "largest dowel (ISO 8734) of" if wish.ring == "pins" else "arcs of the ring,",
    )
    return {
        "pair.pin_circle_radius": f"outer radius less pin radius and a wall of {wall * 1e3:g} mm",
        "pair.pin_radius": f"{pin} at most {_PIN_SHARE:g} of the pins' distance",
        "pair.eccentricity": f"shortening coefficient K = {pair.shortening:.2f}, aimed at {_SHORTENING:g}",
        "pair.face_width": binding,
        "pair.rated_torque": "the wish",
        "pair.discs": "evenly around the crank, so balanced" if wish.discs > 1 else "unbalanced: one disc",
        "modification.isometric": f"with offset: least backlash at which {_YIELD:.0%} of drives by {wish.process} turn",
        "material.gear": MATERIALS[wish.material].source.split(";")[0],
        "material.pin": MATERIALS[wish.material_of_pins].source.split(";")[0],
        "material.output_pin": "for their strength",
        "material.ring": "for its strength",
    }


def _notes(wish: Wish) -> list[str]:
    """Return what is assumed of ring and discs, one sentence each."""
    gear = MATERIALS[wish.material]
    notes = [
        "A first drive: sizes by rules, modification and face width by the search of `design`"
        + ("; bodies are elastic." if wish.bodies else "; its bodies are rigid, so the real drive is softer."),
    ]
    if wish.life is not None:
        rpm = wish.crank_speed * 30.0 / math.pi
        notes.append(f"Wished: an L10 life of the eccentric bearing of {wish.life / 3600.0:.4g} h at {rpm:.4g} rpm.")
    elif wish.output == "gear":
        notes.append("No life was wished for: the eccentric bearing is the largest that fits, however long it lives.")
    if wish.ring == "conjugate":
        notes.append(
            "Ring without pins: in the model its arcs are fixed pins of the discs' material; between them it must stay "
            "outside of the discs' teeth."
        )
    if gear.creeps:
        notes.append(
            f"{wish.material} creeps: under lasting load modulus and strength fall to a half or less, which is not "
            f"computed; keep below {gear.service_temperature - 273.15:.0f} degC."
        )
    return notes


def _modified(pair: Pair, wish: Wish, tolerance_text: str, progress: Callable[[str], None], searched: bool) -> Pair:
    """Return the pair with the modification of least backlash at which drives of the process turn freely.

    Without a search it is the one that a search usually ends with, of a drive for which there is one.
    """
    position = PROCESSES[wish.process].position(2.0 * pair.pin_circle_radius)
    tolerances = parse_tolerances(tolerance_text, "tolerances of the process")
    most = round(min(_MODIFICATION * position, 0.9e-3, 0.3 * pair.pin_radius), 9)
    largest = pair.replace(isometric=most)
    largest_pressure(largest)  # refuses a torque that no contacts balance: the search would name its ranges
    if (share := _free(largest, tolerances)) < _YIELD:
        problem = f"{share:.0%} of drives turn freely at the largest modification, {most * 1e6:.0f} um"
        raise _ImpossibleError("process", problem, wish.process)
    if not searched:
        return pair.replace(isometric=min(_USUAL_CLEARANCE * position, most))
    task = DesignTask(
        goals=("backlash",),
        vary={"isometric": (0.0, most), "offset": (-most, 0.0)},
        limits={"interference": 0.0},
        robust={"yield": _YIELD, "samples": _SAMPLES},
    )
    start = pair.replace(isometric=0.5 * most, offset=-0.25 * most)
    progress("modification")
    (found,) = search(start, task, tolerances, starts=0)
    pair = found.pair
    # The search has its own drives; others decide, and a step more of clearance where too few of them turn.
    while _free(pair, tolerances) < _YIELD:
        larger = pair.modification.isometric + _STEP * most
        if larger > most:
            return largest
        pair = pair.replace(isometric=round(larger, 9))
    return pair


def _free(pair: Pair, tolerances: Tolerances) -> float:
    """Return the share of sampled drives that turn without interference."""
    # Without a rated torque, and so without its share for the lost motion, which some drives carry on no flank.
    bare, torque = pair.replace(rated_torque=None), (pair.rated_load(),)
    angles = out_of_step(pair.pins, _ANGLES)
    study = Study(bare, tolerances, samples=_JUDGED, seed=_SEED, torque=torque, angles=angles)
    interference = [name for name, _ in study.columns].index("interference")
    surfaces = [surface_of(study, point) for point in points(study)]
    return float((exact_figures(study, surfaces)[:, interference] <= 0.0).mean())


def _wide_enough(
    pair: Pair, wish: Wish, process: Process, pressure: float, progress: Callable[[str], None]
) -> tuple[Pair, str]:
    """Return the pair with the least face width at which the pressure is permitted, and why it is that."""
    least = max(_LEAST_WIDTH, process.wall)
    most = _widest(wish)
    reached = largest_pressure(pair.replace(face_width=most))
    if reached > pressure:
        raise _too_much(wish, f"at the largest face width, {most * 1e3:.3g} mm a disc,", reached, pressure)
    task = DesignTask(
        goals=("face_width",), vary={"face_width": (least, most)}, limits={"max_contact_pressure": pressure}
    )
    progress("face width")
    (found,) = search(pair.replace(face_width=most), task, starts=0)
    needed = found.pair.face_width
    why = f"for {pressure * 1e-6:.0f} MPa at rated torque as drawn" if needed > 1.001 * least else "the least by rule"
    return found.pair.replace(face_width=min(_half_mm(needed), round(most, 6))), why


def _too_much(wish: Wish, where: str, reached: float, pressure: float) -> _ImpossibleError:
    """Return the error of a torque under which the contact pressure is too high, Pa."""
    said = (
        f"{where} the contact pressure is {reached * 1e-6:.4g} MPa, and {wish.material} bears {pressure * 1e-6:.4g} MPa"
    )
    return _ImpossibleError("torque", said, wish.torque)


def _widest(wish: Wish) -> float:
    """Return the largest face width of a disc, m."""
    least, gaps = max(_LEAST_WIDTH, PROCESSES[wish.process].wall), _GAP * (wish.discs + 1)
    discs = f"{wish.discs} discs of at least {least * 1e3:.3g} mm"
    most = _LARGEST_WIDTH * wish.outer_diameter / wish.discs
    if most < least:
        problem = f"{discs} are wider than {_LARGEST_WIDTH:g} of it"
        raise _ImpossibleError("outer_diameter", problem, wish.outer_diameter)
    if wish.length is None:
        return most
    if wish.length < wish.discs * least + gaps:
        problem = f"{discs} with gaps of {_GAP * 1e3:g} mm take {(wish.discs * least + gaps) * 1e3:.3g} mm"
        raise _ImpossibleError("length", problem, wish.length)
    return min(most, (wish.length - gaps) / wish.discs)


def _length(pair: Pair) -> float:
    """Return what the discs take along the axis with gaps between and beside them, m."""
    return pair.discs * pair.face_width + (pair.discs + 1) * _GAP


class _Output(NamedTuple):
    """Supports and losses of a drive with output pins, with their reasons and notes.

    The last are the radius of the eccentric bearing's seat in the discs, the bearing's width, m, and the stiffness of
    an output pin's contact alone, N/m.
    """

    supports: Supports
    losses: Losses | None
    reasons: dict[str, str]
    notes: list[str]
    bearing_seat: float
    bearing_width: float
    contact_stiffness: float

    @property
    def rollers(self) -> OutputRoller:
        """The output pins."""
        assert self.supports.output_roller is not None
        return self.supports.output_roller


def _bodies(wish: Wish, pair: Pair, output: _Output) -> Bodies:
    """Return discs, output pins and ring as elastic bodies; the crank's shape is not known, pins lie in the ring."""
    rollers = output.rollers
    assert rollers.radius is not None
    half = round(0.5 * _length(pair), 9)
    hole = rollers.radius + pair.eccentricity + 0.5 * rollers.clearance
    return Bodies(
        disc_spacing=round(pair.face_width + _GAP, 9),
        disc={"bore_radius": output.bearing_seat, "roller_hole_radius": round(hole, 9)},
        output_pin={"ends": "clamped", "from": -half, "to": half, "diameter": 2.0 * rollers.radius},
        ring={"outer_radius": 0.5 * wish.outer_diameter, "width": 2.0 * half},
    )


def _output(wish: Wish, pair: Pair, process: Process, capacity: float) -> _Output:
    """Return supports and losses of a drive with output pins: pins and eccentric bearing that fit.

    `capacity` is the least dynamic capacity of the bearing, N.

    Raises
    ------
    edge.InputError
        If nothing fits between the crank and the flank's roots.
    """
    root = pair.pin_circle_radius - pair.pin_radius - pair.eccentricity
    wall, e = process.wall, pair.eccentricity
    input_torque = wish.torque / abs(pair.ratio)
    shaft = (2.0 * input_torque / (math.pi * _SHEAR)) ** (1.0 / 3.0)  # radius
    length = _length(pair)
    strength = MATERIALS[_OUTPUT_STEEL].bending_fatigue
    assert strength is not None
    allowed = strength[0] / _SAFETY
    for counts, bearing in itertools.product(_OUTPUT_PINS, reversed(_BALL_BEARINGS)):
        bore, outside, ball_width, rating = bearing
        if 0.5e-3 * bore < shaft + e + 1e-3 or 1e-3 * ball_width > _widest(wish) or 1e3 * rating < capacity:
            continue
        inner, room = 0.5e-3 * outside + wall, 0.5 * (root - 0.5e-3 * outside) - wall
        circle = round(0.5 * (inner + root - wall), 4)
        for count in counts:
            force = 4.0 * wish.torque / (pair.discs * count * circle)
            needed = (8.0 * force * length / (math.pi * allowed)) ** (1.0 / 3.0)  # M = F l/4 of a beam on two supports
            pin = next((0.5e-3 * d for d in _DOWELS if 1e-3 * d >= needed), math.inf)
            hole = pin + e
            if hole > room or 2.0 * circle * math.sin(math.pi / count) < 2.0 * hole + wall:
                continue
            return _with_output(wish, pair, bearing, circle, count, pin, force, length)
    inside = f"with output pins fits inside the flank's roots, {2e3 * root:.3g} mm in diameter"
    if capacity > 0.0:
        problem = f"it needs a dynamic capacity of {capacity * 1e-3:.3g} kN, and no such eccentric bearing {inside}"
        raise _ImpossibleError("life", problem, wish.life)
    raise _ImpossibleError("outer_diameter", f"no eccentric bearing {inside}", wish.outer_diameter)


def _held(wish: Wish, pair: Pair, process: Process, pressure: float) -> tuple[_Output, Pair]:
    """Return output and bearings, and the drive on them, as much wider as their play and give make necessary.

    Where the wish has elastic bodies the drive has them too. The bearing is one that lives as long as wished.
    """
    most, capacity, held, reached = _widest(wish), 0.0, pair, math.inf
    for _ in range(_ADAPTED):
        output = _output(wish, pair, process, capacity)
        if pair.face_width < output.bearing_width:
            pair = pair.replace(face_width=output.bearing_width)
            continue
        held = _on_bearings(wish, pair, output)
        solved = _at_rated_torque(held)
        (shorter, of), *_ = sorted(
            (each.life, each.exponent) for each in bearing_loads(held, solved) if each.life > 0.0
        )
        if shorter < wish.crank_turns:
            rating = output.supports.turning_arm.dynamic_capacity or 0.0
            capacity = rating * (wish.crank_turns / shorter) ** (1.0 / of)
            continue
        reached = float(solved.max_contact_pressure.max())
        if reached <= pressure:
            return output, held
        pair = pair.replace(face_width=_half_mm(pair.face_width * (reached / pressure) ** 2))
        if pair.face_width > most:
            break
    where = "on its bearings" + (", with elastic bodies" if wish.bodies else "")
    raise _too_much(wish, f"{where}, {1e3 * held.face_width:.3g} mm a disc,", reached, pressure)


def _on_bearings(wish: Wish, pair: Pair, output: _Output) -> Pair:
    """Return the drive on its bearings, with elastic bodies where the wish has them."""
    held = pair.replace(supports=output.supports, losses=output.losses)
    if not wish.bodies:
        return held
    rollers = output.rollers.replace(stiffness=output.contact_stiffness)
    return held.replace(bodies=_bodies(wish, pair, output), supports=output.supports.replace(output_roller=rollers))


def _half_mm(width: float) -> float:
    """Round a width (m) up to half a millimetre."""
    return round(0.5e-3 * math.ceil(width * 2e3 - 1e-9), 6)


def _with_output(
    wish: Wish,
    pair: Pair,
    bearing: Sequence[float],
    circle: float,
    count: int,
    pin: float,
    force: float,
    length: float,
) -> _Output:
    bore, outside, ball_width, capacity = bearing
    process = PROCESSES[wish.process]
    arm_force = 1.25 * wish.torque / (pair.discs * pair.eccentricity * pair.gear_teeth)
    stiffness = _ball_bearing_stiffness(arm_force, 1e-3 * bore, 1e-3 * outside)
    bending = 48.0 * MATERIALS[_OUTPUT_STEEL].modulus * math.pi * pin**4 / 4.0 / length**3
    contact = _roller_stiffness(pair, pin, force)
    clearance = round(standard_tolerance(process.grade, 2.0 * (pin + pair.eccentricity)), 6)
    supports = Supports(
        kind="output_rollers",
        count=count,
        circle_radius=circle,
        turning_arm={
            "stiffness": _three(stiffness),
            "dynamic_capacity": round(1e3 * capacity, 3),
            "rolling_elements": "balls",
            "raceway_diameter": outside / 1e3,
        },
        output_roller={
            "stiffness": _three(1.0 / (1.0 / bending + 1.0 / contact)),
            "clearance": min(clearance, 2e-4),
            "radius": pin,
        },
    )
    losses = _losses(wish, pin, bore, outside)
    reasons = {
        "supports.count": f"output pins of {2e3 * pin:g} mm in holes of {2e3 * (pin + pair.eccentricity):.4g} mm",
        "supports.circle_radius": "between the eccentric bearing and the roots of the flank",
        "supports.turning_arm": f"ball bearing {bore:g} x {outside:g} mm, series 618; stiffness by Palmgren",
        "supports.turning_arm.raceway_diameter": "its outer ring's outside, the bore of the discs",
        "supports.output_roller": f"contact and bending, held at both ends, at {force:.0f} N",
        "losses.flank": "values to begin with; measure the drive",
        "losses.output_contact": "pins that do not turn; bushings would lose less",
        "losses.turning_arm": "deep groove, greased (Palmgren)",
        "losses.lubricant": "assumed: a grease's base oil, ISO VG 100",
    }
    notes = [
        "Rigid here, because nothing is known of them: crank shaft and its bearings, main bearing, pin seats.",
        "Assumed: pins lie in the ring over their width, output pins are held at both ends.",
    ]
    if losses is None:
        notes.append(
            f"Efficiency and torques from rest are not known: no friction of {wish.material} on "
            f"{wish.material_of_pins} is in the table; state [losses]."
        )
    if clearance > 2e-4:
        notes.append(f"The clearance of the output holes would be {clearance * 1e6:.0f} µm; the model ends at 200 µm.")
    return _Output(supports, losses, reasons, notes, outside / 2e3, ball_width / 1e3, _three(contact))


def _losses(wish: Wish, pin: float, bore: float, outside: float) -> Losses | None:
    """Return friction to begin with; None where no source states it for the discs on pins of their material."""
    if not any("steel" in name for name in (wish.material, wish.material_of_pins)):
        return None
    friction = _friction_of(wish)
    return Losses(
        flank={"friction": friction},
        output_contact={"friction": friction},
        output_roller={"outer_radius": pin},
        turning_arm={
            "mean_diameter": round(0.5e-3 * (bore + outside), 6),
            "load_factor": _BEARING_LOAD,
            "speed_factor": _BEARING_SPEED,
        },
        lubricant={"viscosity_40": 100e-6, "viscosity_100": 11e-6, "temperature": 313.15},
    )


def _three(value: float) -> float:
    """Round to three significant digits."""
    return float(f"{value:.3g}")


def _ball_bearing_stiffness(force: float, bore: float, outside: float) -> float:
    """Return the secant radial stiffness of a deep groove bearing without clearance, N/m.

    δ = 4.36e-4 Q^(2/3)/D_w^(1/3) mm, Q = 5F/z (Palmgren; Harris, Rolling Bearing Analysis), with balls of D_w = 0.3
    (D - d) and z = 2.9 (D + d)/(D - d) of them (Eschmann, Ball and Roller Bearings).
    """
    ball, balls = 0.3 * (outside - bore), 2.9 * (outside + bore) / (outside - bore)
    deflection = 4.36e-7 * math.cbrt((5.0 * force / balls) ** 2 / (1e3 * ball))
    return force / deflection


def _roller_stiffness(pair: Pair, pin: float, force: float) -> float:
    """Return the secant stiffness of an output pin in its hole by Hertz's line contact, N/m."""
    from scipy.optimize import brentq

    from cycloid_fmu.contact.hertz import hertz

    given = (-1.0 / (pin + pair.eccentricity), pin, pair.face_width)
    elastic = (pair.material.gear.compliance, pair.material.pin.compliance, pair.pin_circle_radius)
    approach = brentq(lambda value: hertz(value, *given, *elastic)[0] - force, 1e-12, 0.2 * pin)
    return float(force / approach)


def _friction_of(wish: Wish) -> str:
    """Return the entry of `friction_values.VALUES` for discs and pins of which at least one is of steel."""
    soft = [name for name in (wish.material, wish.material_of_pins) if MATERIALS[name].creeps]
    return {"POM": "POM, dry"}.get(soft[0], "plastic, dry") if soft else "steel, grease"


def _nearest(wish: Wish, progress: Callable[[str], None]) -> str:
    """Return what is possible instead: values of a wish that were sized, each with the others as wished."""

    def possible(name: str, value: float, searched: bool = False) -> bool:
        try:
            _sized(wish.replace(**{name: value}), lambda step: None, search_modification=searched)
        except edge.InputError:
            return False
        return True

    offers = []
    for name, unit, shown, step in _LEVERS:
        if (wished := getattr(wish, name)) is None:
            continue
        progress(f"nearest possible {name.replace('_', ' ')}")
        far = next((float(k) for k in range(1, _TRIALS + 1) if possible(name, wished * step**k)), None)
        if far is None:
            continue
        near = far - 1.0
        for _ in range(_TRIALS):
            middle = 0.5 * (near + far)
            near, far = (near, middle) if possible(name, wished * step**middle) else (middle, far)
        # With the modification that is searched for it may need a little more.
        for end in far + np.arange(_TRIALS) * 0.5**_TRIALS:
            offer = _three_digits(wished * step**end * shown, step > 1.0)
            if possible(name, offer / shown, searched=True):
                offers.append(f"{offer:g} {unit}")
                break
    if not offers:
        words = [name.replace("_", " ") for name, *_ in _LEVERS if getattr(wish, name)]
        return f"no other {' or '.join(words)} by itself would do"
    return f"{' or '.join(offers)} would be possible"


def _three_digits(value: float, up: bool) -> float:
    """Round a value above zero up or down to three significant digits."""
    digit = 10.0 ** (math.floor(math.log10(value)) - 2)
    return (math.ceil if up else math.floor)(value / digit) * digit


def _at_rated_torque(pair: Pair) -> Transmission:
    """Return a drive at its rated torque over a crank turn."""
    turn = np.linspace(0.0, 2.0 * np.pi, out_of_step(pair.pins, _ANGLES), endpoint=False)
    return solve(DriveValue(pair, surface_of_pair(pair)), np.array([pair.rated_load()]), turn, with_play=False)


def largest_pressure(pair: Pair) -> float:
    """Return the largest contact pressure of a drive at its rated torque over a crank turn, Pa."""
    return float(_at_rated_torque(pair).max_contact_pressure.max())


SIZED_FILES = ("drive.toml", "tolerances.toml", "figures.json")
"""What `write_sizing` writes."""


def write_sizing(drive: Sizing, folder: str | os.PathLike[str], figures: Mapping[str, Any]) -> None:
    """Write a first drive with its figures into a folder, which is created: `SIZED_FILES`.

    Raises
    ------
    edge.InputError
        If a file can't be written.
    """
    target = edge.created_folder(folder)
    texts = (drive.text, drive.tolerances, edge.json_text(dict(figures)))
    for name, text in zip(SIZED_FILES, texts, strict=True):
        with edge.written_whole(target / name) as temporary:
            temporary.write_text(text, encoding="utf-8")
