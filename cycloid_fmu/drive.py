"""A drive: a gear pair with its actual errors, and the functions that compute with it."""

from __future__ import annotations

import dataclasses
import math
import os
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cycloid_fmu import edge
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.edge.quantities import FIELD_UNITS
from cycloid_fmu.errors.kinds import KINDS, kind_of, names_of
from cycloid_fmu.errors.stated import Errors
from cycloid_fmu.geometry import ANGLES
from cycloid_fmu.geometry.pair import Pair
from cycloid_fmu.surfaces.provenance import stating
from cycloid_fmu.surfaces.structured import dimensions, profile_wave
from cycloid_fmu.surfaces.surface import ErrorSurface, check_surface, stated_values, surface_of_pair

if TYPE_CHECKING:
    import xarray as xr

    from cycloid_fmu.cad.profile import Profile
    from cycloid_fmu.compensation.compensator import Compensator
    from cycloid_fmu.fmu.friction_file import Friction
    from cycloid_fmu.fmu.variables import Interface
    from cycloid_fmu.geometry.bodies import Bodies
    from cycloid_fmu.geometry.first_stage import FirstStage
    from cycloid_fmu.joint.document import Joint
    from cycloid_fmu.losses.figures import LossFigures
    from cycloid_fmu.losses.heat import Heat
    from cycloid_fmu.motion import Motion
    from cycloid_fmu.reducer.description import Reducer
    from cycloid_fmu.studies.design import Design
    from cycloid_fmu.studies.limits import Requirements
    from cycloid_fmu.studies.verdicts import Judged
    from cycloid_fmu.studies.yields import Findings
    from cycloid_fmu.supports.figures import BearingLoad, Share
    from cycloid_fmu.surfaces.sampling import Tolerances
    from cycloid_fmu.wear.law import WearLaw
    from cycloid_fmu.wear.life import WearRun

Array = NDArray[np.float64]


def _quantity(name: str, given: Any, unit: str) -> float:
    try:
        return edge.quantity(given, unit)
    except ValueError as problem:
        raise edge.ArgumentError(name, str(problem), given) from None


def _torque(given: Any) -> float:
    return _quantity("torque", given, "N*m")


def _torques(given: Any, pair: Pair) -> list[float]:
    """One torque or several, as numbers or text; the rated torque for None."""
    if given is None:
        return [pair.rated_load()]
    return [_torque(one) for one in ([given] if isinstance(given, str) or np.ndim(given) == 0 else given)]


def _crank_angles(pair: Pair, angles: int, turns: int = 1) -> Array:
    """Return crank angles evenly over whole turns from 0, end excluded, rad; warn if they miss part of the mesh."""
    from cycloid_fmu.analysis import step_notes

    for note in step_notes(pair.pins, angles, turns):
        warnings.warn(note, edge.InputWarning, stacklevel=3)
    return np.linspace(0.0, 2.0 * math.pi * turns, angles, endpoint=False)


def _cores(workers: int | None = None) -> int:
    """Return the number of workers, by default one per core."""
    return workers or os.cpu_count() or 1


def _requirements(given: Requirements | str | os.PathLike[str]) -> Requirements:
    if isinstance(given, str | os.PathLike):
        from cycloid_fmu.studies.limits import read_requirements

        return read_requirements(given)
    return given


def _tolerances(given: Tolerances | str | os.PathLike[str]) -> Tolerances:
    if isinstance(given, str | os.PathLike):
        from cycloid_fmu.surfaces.sampling import read_tolerances

        return read_tolerances(given)
    return given


class Drive(DriveValue):
    """A gear pair with its errors: everything that the contact model needs. Immutable, equal by value.

    Parameters
    ----------
    pair
        The gear pair, whose stated errors are those of the drive unless a surface is given; or an RV reducer with its
        cycloid stage, errors and first stage.
    surface
        The actual errors of the same pair.
    first_stage
        The involute stage that turns the cranks; None if a motor turns them.

    Attributes
    ----------
    pair
        The pair with the errors of the drive.
    surface
        The drive's errors as an error surface.
    first_stage
        The involute stage before the cranks, or None. With it, transmission error, stiffness and play are those of the
        output with the sun locked.

    Raises
    ------
    edge.InputError
        If the surface belongs to another pair.

    Examples
    --------
    >>> import cycloid_fmu as cy
    >>> pair = cy.Pair(
    ...     gear_teeth=39, pin_circle_radius="64 mm", pin_radius="3 mm", eccentricity="1.3 mm", face_width="10 mm"
    ... )
    >>> drive = cy.Drive(pair).replace(offset=-30e-6, errors={"pin_radius": "-1 um"})
    >>> drive.surface.pin_radius
    -1e-06
    >>> data = drive.analyze(torque=[20, "200 N*m"], angles=90)
    >>> data.sizes["torque"], data.sizes["crank_angle"]
    (2, 90)
    """

    def __init__(
        self, pair: Pair | Reducer, surface: ErrorSurface | None = None, first_stage: FirstStage | None = None
    ) -> None:
        if not isinstance(pair, Pair):
            from cycloid_fmu.reducer.lost_motion import parts_of

            pair, made, first_stage = parts_of(pair)
            surface = made if surface is None else surface
        if surface is None:
            surface = surface_of_pair(pair)
        else:
            check_surface(pair, surface, "the pair", "the surface")
            pair = pair if surface_of_pair(pair) == surface else stating(pair, surface)
        self.__dict__.update(pair=pair, surface=surface, first_stage=first_stage)

    def __repr__(self) -> str:
        pair, errors = self.pair, ", ".join(self.pair.errors) or "none"
        first = "" if self.first_stage is None else f", first stage {self.first_stage.text}"
        return f"Drive({pair.gear_teeth}/{pair.pins}, discs {pair.discs}, errors: {errors}{first}, hash {self.hash})"

    def replace(self, errors: Mapping[str, Any] | None = None, **changes: Any) -> Self:
        """Return a copy with changed values, validated as a file is.

        Parameters
        ----------
        errors
            The changed errors, by their keys in a pair file (`pin_radius_each`) or their names; all others are kept.
        changes
            Values of the pair, including `isometric` and `offset` of its modification, or `surface`.

        Raises
        ------
        edge.InputError
            As for `Pair` and `ErrorSurface`.
        """
        names = {kind.name: kind.file_key for kind in KINDS.values()}
        given = {names.get(name, name): value for name, value in (errors or {}).items()}
        surface = changes.pop("surface", self.surface)
        if surface == surface_of_pair(self.pair):
            return type(self)(self.pair.replace(errors=given, **changes), None, self.first_stage)
        pair, stated = self.pair.nominal.replace(**changes), Errors(given)
        changed = {kind.name for kind in KINDS.values() if kind.file_key in given}
        kept = {name: values for name, values in surface.errors.items() if name not in changed}
        values = {**kept, **stated_values(pair, stated)}
        # The covariance of a fit does not apply to changed values.
        return type(self)(
            pair, surface.replace(pair=pair, errors=values, covariance=None, covariance_of=()), self.first_stage
        )

    def analyze(
        self,
        torque: ArrayLike | str | Sequence[float | str] | None = None,
        *,
        crank_angle: ArrayLike | None = None,
        angles: int = ANGLES,
        turns: int = 1,
        slices: int | None = None,
        workers: int | None = None,
        progress: Callable[[int], None] = lambda angles: None,
    ) -> xr.Dataset:
        """Transmission error, backlash, stiffness, load sharing and pressure over a crank sweep.

        Parameters
        ----------
        torque
            Torque of the environment on the output, counter-clockwise positive, N·m or text with a unit; one or
            several; by default the rated torque. At 0 the transmission error is the middle of the play.
        crank_angle
            Crank angles, rad; by default `angles` of them, evenly spaced over `turns` crank turns from 0, end excluded.
        slices
            Number of slices across the face width; adds contact lines and the pressure on each element. By default as
            many as the errors need, without these outputs.
        workers
            Number of threads; by default one per core.
        progress
            Called with the number of crank angles (times loads) that were just finished.

        Returns
        -------
        xarray.Dataset
            Over `torque` and `crank_angle`, SI, with units (format `cycloid-analysis/1`). `field_units` converts it.

        Raises
        ------
        edge.InputError
            If there is neither a torque nor a rated torque, or a torque can't be carried.
        """
        from cycloid_fmu.analysis import analyze

        if crank_angle is None:
            crank_angle = _crank_angles(self.pair, angles, turns)
        return analyze(
            self,
            _torques(torque, self.pair),
            crank_angle,
            slices,
            with_elements=slices is not None,
            workers=_cores(workers),
            progress=progress,
        )

    def losses(
        self,
        torque: ArrayLike | str | Sequence[float | str] | None = None,
        crank_speed: float | str = 0.0,
        *,
        angles: int = ANGLES,
        turns: int = 1,
        workers: int | None = None,
        progress: Callable[[int], None] = lambda angles: None,
    ) -> LossFigures:
        """Efficiency, losses by part, starting, running and back-driving torque, with friction as in `[losses]`.

        Parameters
        ----------
        torque
            Torque of the environment on the output, counter-clockwise positive, N·m or text with a unit; one or
            several; by default the rated torque. Each is solved in both directions of the crank.
        crank_speed
            Speed of the crank, rad/s or text with a unit; at 0 friction is that at rest.
        angles, turns
            Number of crank angles, and of the crank turns that they span.
        workers, progress
            As for `analyze`.

        Raises
        ------
        edge.InputError
            If no friction is stated, there is no torque, or a bearing lacks the lubricant's viscosity.

        Examples
        --------
        >>> import cycloid_fmu as cy
        >>> pair = cy.Pair(
        ...     gear_teeth=39, pin_circle_radius="64 mm", pin_radius="3 mm", eccentricity="1.3 mm", face_width="10 mm",
        ...     rated_torque="181 N*m",
        ...     supports={"kind": "cranks", "count": 3, "circle_radius": "36 mm", "main": {"stiffness": "900 N/um"}},
        ...     losses={"flank": {"friction_coefficient": 0.06}},
        ... )
        >>> found = cy.Drive(pair).losses(crank_speed="600 rpm", angles=40)
        >>> [(case.mode, round(case.efficiency, 3)) for case in found.cases]
        [('driving', 0.93), ('back-driving', 0.939)]
        """
        from cycloid_fmu.losses.figures import figures

        speed = _quantity("crank_speed", crank_speed, "rad/s")
        if not speed >= 0.0:
            raise edge.ArgumentError(
                "crank_speed", "it must not be below zero; both directions are solved", crank_speed
            )
        return figures(
            self,
            _torques(torque, self.pair),
            _crank_angles(self.pair, angles, turns),
            speed,
            workers=_cores(workers),
            progress=progress,
        )

    def heat(
        self,
        torque: float | str | None = None,
        crank_speed: float | str | None = None,
        *,
        requirements: Requirements | str | os.PathLike[str] | None = None,
        angles: int = ANGLES,
        turns: int = 1,
        workers: int | None = None,
        progress: Callable[[int], None] = lambda temperatures: None,
    ) -> Heat:
        """Steady temperature and warm-up, by the losses of `[losses]` and what `[thermal]` gives off.

        Viscosity and clearances are those of each temperature. The loads are driven.

        Parameters
        ----------
        torque
            Torque of the environment on the output, N·m or text with a unit; by default the rated torque.
        crank_speed
            Speed of the crank, rad/s or text with a unit.
        requirements
            Requirements of the application, or their file, with the duty in place of torque and speed.
        angles, turns
            Number of crank angles, and of the crank turns that they span.
        workers, progress
            As for `analyze`; function called with 1 for each temperature that was just solved.

        Raises
        ------
        edge.InputError
            If [thermal] or [losses] is missing, or nothing turns.

        Examples
        --------
        >>> import cycloid_fmu as cy
        >>> pair = cy.Pair(
        ...     gear_teeth=39, pin_circle_radius="64 mm", pin_radius="3 mm", eccentricity="1.3 mm", face_width="10 mm",
        ...     rated_torque="181 N*m",
        ...     supports={"kind": "cranks", "count": 3, "circle_radius": "36 mm", "main": {"stiffness": "900 N/um"}},
        ...     losses={"flank": {"friction_coefficient": 0.06}},
        ...     thermal={"resistance": "1.5 K/W", "capacity": "3 kJ/K", "ambient": "20 degC"},
        ... )
        >>> found = cy.Drive(pair).heat(crank_speed="600 rpm", angles=40)
        >>> round(found.oil - 273.15), round(found.time_to(0.95) / 60)
        (53, 225)
        """
        from cycloid_fmu.losses.heat import Running, heat

        if requirements is not None:
            rows = _requirements(requirements).duty
            running = [Running(row.torque, row.output_speed * abs(self.pair.ratio), row.share) for row in rows]
        else:
            speed = _quantity("crank_speed", 0.0 if crank_speed is None else crank_speed, "rad/s")
            running = [Running(_torques(torque, self.pair)[0], speed)]
        turning = [load for load in running if load.crank_speed > 0.0]
        if not turning:
            raise edge.ArgumentError(
                "crank_speed", "a drive that gets warm turns; give a speed above zero", crank_speed
            )
        return heat(self, turning, _crank_angles(self.pair, angles, turns), workers=_cores(workers), progress=progress)

    def motion(
        self,
        torque: ArrayLike | str | Sequence[float | str] | None = None,
        crank_angle: ArrayLike | str = 0.0,
        *,
        exaggeration: float | None = None,
        progress: Callable[[int], None] = lambda angles: None,
    ) -> Motion:
        """Positions of discs, pins and contacts, and their forces; `cycloid_fmu.plot` draws them, in `.html` as a page.

        Parameters
        ----------
        torque
            Torque of the environment on the output, counter-clockwise positive, N·m or text with a unit; one or
            several; by default the rated torque. At 0 the output is in the middle of its play. Behind a first stage it
            is the torque on the cycloid stage's output, and only that stage is included.
        crank_angle
            Crank angle, rad or text with a unit; one, or several for an animated page.
        exaggeration
            Enlargement of the gaps between discs and pins in pictures, 1 to 1000; None for the largest round number
            that fits.
        progress
            Called with the number of crank angles (times loads) that were just finished.

        Returns
        -------
        cycloid_fmu.motion.Motion
            Over loads and crank angles, SI.

        Raises
        ------
        edge.InputError
            If there is neither a torque nor a rated torque, a torque can't be carried, or the crank angle or
            exaggeration is out of range.

        Examples
        --------
        >>> import cycloid_fmu as cy, pathlib
        >>> pair = cy.Pair(
        ...     gear_teeth=39, pin_circle_radius="64 mm", pin_radius="3 mm", eccentricity="1.3 mm", face_width="10 mm"
        ... ).replace(offset="-40 um", isometric="-15 um")
        >>> motion = cy.Drive(pair).motion("181 N*m", "30 deg")
        >>> motion.exaggeration, round(float(motion.gap[0, 0, 0, 20].min() * 1e6), 1)
        (20.0, 20.6)
        >>> _ = cy.plot(motion, "drive.html")
        >>> "181 N·m" in pathlib.Path("drive.html").read_text(encoding="utf-8")
        True
        """
        from cycloid_fmu.motion import LARGEST_FACTOR, motion_of

        if exaggeration is not None and not 1.0 <= exaggeration <= LARGEST_FACTOR:
            raise edge.ArgumentError("exaggeration", f"it must be between 1 and {LARGEST_FACTOR:g}", exaggeration)
        if isinstance(crank_angle, str):
            crank_angle = _quantity("crank_angle", crank_angle, "rad")
        if not np.isfinite(crank_angle).all():
            raise edge.ArgumentError("crank_angle", "it must be finite", crank_angle)
        found = motion_of(self.stage, _torques(torque, self.pair), crank_angle, exaggeration, progress=progress)
        return dataclasses.replace(found, behind_first_stage=self.first_stage is not None)

    def judge(
        self,
        requirements: Requirements | str | os.PathLike[str],
        torque: float | str | Sequence[float | str] | None = None,
        *,
        angles: int = ANGLES,
        turns: int = 1,
        workers: int | None = None,
        progress: Callable[[int], None] = lambda angles: None,
    ) -> Judged:
        """Judge each limit: whether it is met, the margin and the worst position; with bearing lives and sliding.

        Parameters
        ----------
        requirements
            The requirements of the application, or their file (cycloid-requirements/1).
        torque
            Torque of the environment on the output, counter-clockwise positive, N·m or text with a unit; one or
            several. Those of the duty are added; without either it is the rated torque.
        angles, turns
            Number of crank angles, and of the crank turns that they span.
        workers, progress
            As for `analyze`.

        Raises
        ------
        edge.InputError
            If the file can't be read, there is no torque or one can't be carried, or the pair lacks a value that a
            limit needs.

        Examples
        --------
        >>> import cycloid_fmu as cy
        >>> from cycloid_fmu.studies.limits import Requirements
        >>> pair = cy.Pair(
        ...     gear_teeth=39, pin_circle_radius="64 mm", pin_radius="3 mm", eccentricity="1.3 mm", face_width="10 mm"
        ... )
        >>> asked = Requirements(limits={"max_contact_pressure": "1000 MPa", "backlash": "1 arcmin"})
        >>> [(one.figure, one.met) for one in cy.Drive(pair).judge(asked, "181 N*m", angles=45).verdicts]
        [('backlash', True), ('max_contact_pressure', False)]
        """
        from cycloid_fmu.studies.verdicts import judge_drive

        stated = _requirements(requirements)
        return judge_drive(
            self,
            stated,
            [] if torque is None else _torques(torque, self.pair),
            _crank_angles(self.pair, angles, turns),
            workers=_cores(workers),
            progress=progress,
        )

    def compliance(self, *, progress: Callable[[int], None] = lambda parts: None) -> list[Share]:
        """Shares of mesh, bearings, seats and clearances in compliance and lost motion of the drive as drawn.

        Parameters
        ----------
        progress
            Called after each part.

        Raises
        ------
        edge.InputError
            If the pair has no supports or no rated torque.

        Examples
        --------
        >>> import cycloid_fmu as cy
        >>> pair = cy.Pair(
        ...     gear_teeth=39, pin_circle_radius="64 mm", pin_radius="3 mm", eccentricity="1.3 mm", face_width="10 mm",
        ...     rated_torque="181 N*m", modification={"isometric": "-15 um", "offset": "-40 um"},
        ...     supports={"kind": "cranks", "count": 3, "circle_radius": "36 mm", "main": {"stiffness": "900 N/um"}},
        ... )
        >>> [share.part for share in cy.Drive(pair).compliance()]
        ['mesh', 'main bearing']
        """
        from cycloid_fmu.analysis import compliance

        return compliance(self, progress=progress)

    def influence(
        self,
        crank_angle: float | str = 0.0,
        *,
        bodies: Bodies | None = None,
        disc: int = 0,
        total: Callable[[int], None] = lambda loads: None,
        progress: Callable[[int], None] = lambda loads: None,
    ) -> dict[str, Any]:
        """Influence matrices of the drive's elastic bodies: displacements under unit forces, m/N.

        Computed once for each body, and then from the user's cache folder.

        Parameters
        ----------
        crank_angle
            Crank angle, rad or text with a unit: pins and output rollers are at their ideal places.
        bodies
            The elastic bodies; None for those of the pair.
        disc
            Number of the disc, from 0.
        total, progress
            Called with the number of unit loads of all discs, and with the number that were just solved.

        Returns
        -------
        dict
            By body. `disc`: `teeth`, between the pins, each force on the disc along the inner normal, with the norms
            `frobenius` and `spectral` and the diagonal `self`; `bores`, between x and y of each turning arm, in the
            disc's axes; `rollers`, between the output rollers; `compliance`, between all of these. `pin`, `crank`,
            `output_pin`: between the discs, shape (discs, discs). `ring`: `compliance` between x and y of each pin's
            seat, and its norms. `carrier`: `compliance` between x and y of each crank's place, and the factors
            `translation` and `rotation` (docs/theory/bodies.md).

        Raises
        ------
        edge.InputError
            If the pair has no supports or no bodies, the bodies contradict it or each other, there is no such disc, or
            a computed disc lacks the package scikit-fem of the extra `bodies`.

        Examples
        --------
        >>> import cycloid_fmu as cy
        >>> from cycloid_fmu.geometry.bodies import Bodies
        >>> pair = cy.Pair(
        ...     gear_teeth=39, pin_circle_radius="64 mm", pin_radius="3 mm", eccentricity="1.3 mm", face_width="10 mm",
        ...     supports={"kind": "cranks", "count": 3, "circle_radius": "36 mm"},
        ... )
        >>> bodies = Bodies(ring={"outer_radius": "80 mm", "width": "24 mm"})
        >>> seats = cy.Drive(pair).influence(bodies=bodies)["ring"]["compliance"]
        >>> seats.shape, f"{seats[0, 0]:.2e} m/N"
        ((80, 80), '2.75e-10 m/N')
        """
        from cycloid_fmu.bodies.matrices import influence, matrices_of

        angle = _quantity("crank_angle", crank_angle, "rad")
        if not 0 <= disc < self.pair.discs:
            raise edge.ArgumentError("disc", f"it must be from 0 to {self.pair.discs - 1}", disc)
        bodies = self.pair.bodies if bodies is None else bodies
        if bodies is None:
            raise edge.InputError("the pair has no [bodies]; state them, or give them as `bodies`.")
        return influence(matrices_of(self.pair, bodies, total=total, progress=progress), angle, disc)

    def bearing_loads(
        self, torque: float | str | None = None, *, angles: int = ANGLES, turns: int = 1
    ) -> list[BearingLoad]:
        """Largest and equivalent load of every bearing over whole crank turns, and its basic rating life (ISO 281).

        Parameters
        ----------
        torque
            Torque of the environment on the output, counter-clockwise positive, N·m or text with a unit; by default
            the rated torque.
        angles, turns
            Number of crank angles, and of the crank turns that they span.

        Raises
        ------
        edge.InputError
            If the pair has no supports or the torque can't be carried.
        """
        from cycloid_fmu.analysis import solve
        from cycloid_fmu.supports.figures import bearing_loads

        loads = _torques(torque, self.pair)
        crank_angle = _crank_angles(self.pair, angles, turns)
        found = solve(self, loads, crank_angle, with_play=False)
        return bearing_loads(self.pair, found)

    def sensitivity(
        self,
        torque: float | str | None = None,
        errors: Sequence[str] | None = None,
        *,
        crank_angle: ArrayLike | None = None,
        angles: int = ANGLES,
    ) -> xr.DataArray:
        """Derivatives of the transmission error by the structured errors, at one load.

        Parameters
        ----------
        torque
            Torque of the environment on the output, counter-clockwise positive, N·m or text with a unit, not 0; by
            default the rated torque.
        errors
            Names of errors: kinds with one value, waves such as `pin_radial_1_cos`, orders such as
            `profile_deviation_1`; by default the kinds with one value and the orders 1 to 3. With supports also
            bearings: `turning_arm_stiffness` (by its logarithm, rad), `turning_arm_clearance` (rad/m) and so on, and of
            each elastic body the stiffness: `disc_stiffness` (by its logarithm, rad) and so on.
        crank_angle, angles
            As for `analyze`.

        Returns
        -------
        xarray.DataArray
            Over `error` and `crank_angle`; rad/m, for misalignments rad/rad.

        Raises
        ------
        edge.InputError
            If the torque can't be carried, or a name is not a structured error.

        Examples
        --------
        >>> import cycloid_fmu as cy
        >>> pair = cy.Pair(
        ...     gear_teeth=39, pin_circle_radius="64 mm", pin_radius="3 mm", eccentricity="1.3 mm", face_width="10 mm"
        ... )
        >>> by = cy.Drive(pair).sensitivity("181 N*m", ["eccentricity", "pin_radial_1_cos"], angles=45)
        >>> by.dims, by.shape
        (('error', 'crank_angle'), (2, 45))
        """
        import xarray as xr

        from cycloid_fmu.analysis import error_sensitivity
        from cycloid_fmu.supports.transmission import parameters_of

        if crank_angle is None:
            crank_angle = _crank_angles(self.pair, angles)
        known = [*names_of(self.pair), *parameters_of(self.pair)]
        names = list(errors) if errors is not None else known
        for name in names:
            if name not in known and kind_of(name) is None and profile_wave(name, 1) is None:
                raise edge.ArgumentError("errors", f"no structured error; {edge.did_you_mean(name, known)}", name)
        (load,) = _torques(torque, self.pair)
        _, jacobian = error_sensitivity(self, load, crank_angle, names)
        units = {"units": "rad/m, rad/rad", "long_name": "derivative of the transmission error", "drive": self.hash}
        places = {"error": names, "crank_angle": np.atleast_1d(crank_angle)}
        return xr.DataArray(jacobian.T, places, ("error", "crank_angle"), "sensitivity", units)

    def sample(self, tolerances: Tolerances | str | os.PathLike[str], seed: int) -> Self:
        """Draw one drive within tolerances; the errors of this drive are not included.

        Parameters
        ----------
        tolerances
            The tolerances, or their file.
        seed
            Seed; the same seed draws the same drive.

        Raises
        ------
        edge.InputError
            If the file can't be read or the seed is out of range.

        Examples
        --------
        >>> import cycloid_fmu as cy
        >>> pair = cy.Pair(
        ...     gear_teeth=39, pin_circle_radius="64 mm", pin_radius="3 mm", eccentricity="1.3 mm", face_width="10 mm"
        ... )
        >>> made = cy.Drive(pair).sample(cy.Tolerances(pin_radius={"tolerance": "2 um"}), seed=1)
        >>> abs(made.surface.pin_radius) <= 2e-6
        True
        """
        from cycloid_fmu.surfaces.sampling import sample_surface

        made = sample_surface(self.pair, _tolerances(tolerances), seed)
        return type(self)(self.pair.nominal, made, self.first_stage)

    def study(
        self,
        tolerances: Tolerances | str | os.PathLike[str],
        torque: float | str | Sequence[float | str] | None = None,
        *,
        samples: int = 1000,
        seed: int = 1,
        angles: int = ANGLES,
        requirements: Requirements | str | os.PathLike[str] | None = None,
        workers: int | None = None,
        progress: Callable[[int], None] = lambda drives: None,
    ) -> Findings:
        """Solve many drives within their tolerances; return distributions and yields against limits.

        Parameters
        ----------
        tolerances
            The tolerances and limits, or their file.
        torque
            Torque on the output, N·m or text with a unit; one or several, by default plus and minus the rated torque.
        samples, seed, angles
            Number of drives, seed that determines them, and number of crank angles of each.
        requirements
            Requirements of the application, or their file, whose limits hold in place of those of the tolerances.
        workers, progress
            Number of processes, by default one per core; function called with the number of drives just finished.

        Raises
        ------
        edge.InputError
            If there is neither a torque nor a rated torque, or a tolerance can't be studied.

        Examples
        --------
        >>> import cycloid_fmu as cy
        >>> pair = cy.Pair(
        ...     gear_teeth=39, pin_circle_radius="64 mm", pin_radius="3 mm", eccentricity="1.3 mm", face_width="10 mm"
        ... )
        >>> tolerances = cy.Tolerances(pin_radius={"tolerance": "2 um"}, eccentricity={"tolerance": "3 um"})
        >>> found = cy.Drive(pair).study(tolerances, "100 N*m", samples=4, angles=20, workers=1)
        >>> len(found.result.sample)
        4
        """
        from cycloid_fmu.studies import yields
        from cycloid_fmu.studies.tolerance import Study, check_study

        loads = _torques(torque, self.pair)
        if torque is None:
            loads.append(-loads[0])
        study = Study(
            self.pair, _tolerances(tolerances), samples, seed, tuple(loads), angles=angles, first_stage=self.first_stage
        )
        if requirements is not None:
            study = yields.with_requirements(study, _requirements(requirements))
        check_study(study, "pair", "tolerances")
        return yields.conduct(study, workers=_cores(workers), progress=progress)

    def sweep(
        self,
        vary: Mapping[str, str | Iterable[float | str]],
        torque: float | str | Sequence[float | str] | None = None,
        output: str | os.PathLike[str] | None = None,
        *,
        angles: int = ANGLES,
        turns: int = 1,
        crank_speed: float | str = 0.0,
        workers: int | None = None,
        progress: Callable[[int], None] = lambda drives: None,
    ) -> xr.Dataset:
        """Solve the drive with every combination of several values of its pair file.

        Parameters
        ----------
        vary
            {name in a pair file: its values}, such as `{"pin_radius": "2.5:3.5:11 mm"}`, eleven values with both ends,
            or `{"supports.turning_arm.clearance": ["0 um", "5 um"]}`; other names are `isometric`, `errors.pin_radius`,
            `temperature` of all bodies, and the amplitude `errors.pin_radial.order_2`.
        torque
            Torques on the output, N·m or text with a unit, not 0; by default the rated torque.
        output
            File for the result: netCDF, or a table in field units as CSV or Parquet, by the ending. Until it is
            complete, finished drives are in a file of that name with `.checkpoint` appended, from which the same call
            resumes.
        angles, turns
            Number of crank angles of each drive, and of the crank turns that they span.
        crank_speed
            Speed of the crank, rad/s or text with a unit, for the efficiency of a drive with [losses].
        workers, progress
            Number of processes, by default one per core; function called with the number of drives just finished.

        Returns
        -------
        xarray.Dataset
            Figures over the varied values, those under load over `torque` as well, SI (format `cycloid-sweep/1`). For
            invalid combinations they are NaN, and `reason` gives the reason.

        Raises
        ------
        edge.InputError
            If there is no such value, no load, or no valid combination.

        Examples
        --------
        >>> import cycloid_fmu as cy
        >>> pair = cy.Pair(
        ...     gear_teeth=39, pin_circle_radius="64 mm", pin_radius="3 mm", eccentricity="1.3 mm", face_width="10 mm"
        ... )
        >>> found = cy.Drive(pair).sweep({"offset": "-40:0:3 um", "eccentricity": ["1.3 mm", "1.7 mm"]}, 100, angles=90,
        ...                              workers=1)
        >>> found.backlash.dims, found.angular_transmission_error.shape
        (('offset', 'eccentricity'), (3, 2, 1))
        >>> str(found.reason.values[0, 1])[:62]
        '[pair] eccentricity = "1.7 mm": eccentricity x pins / pin circ'
        """
        from cycloid_fmu.studies.sweep import Sweep, vary_of
        from cycloid_fmu.studies.sweep_files import conduct

        speed = _quantity("crank_speed", crank_speed, "rad/s")
        sweep = Sweep(self, vary_of(vary), tuple(_torques(torque, self.pair)), angles, turns, speed)
        return conduct(sweep, output, workers=_cores(workers), progress=progress)

    def wear(
        self,
        law: WearLaw | str | os.PathLike[str],
        torque: float | str,
        crank_turns: float,
        *,
        workers: int | None = None,
        progress: Callable[[float], None] = lambda turns: None,
    ) -> WearRun:
        """Simulate wear of flanks and pins over a life at one load, with the profile updated as it wears.

        Parameters
        ----------
        law
            The wear law, or its file (cycloid-wear/1).
        torque, crank_turns
            Torque of the environment on the output, counter-clockwise positive, N·m or text with a unit; crank turns of
            the life.
        workers, progress
            Number of threads, by default one per core; function called with the crank turns done so far.

        Returns
        -------
        WearRun
            The run; the worn drive is `Drive(drive.pair.nominal, run.surface)`.

        Raises
        ------
        edge.InputError
            If the law can't be read or the teeth would wear through.

        Examples
        --------
        >>> import cycloid_fmu as cy
        >>> from cycloid_fmu.wear.law import WearLaw
        >>> pair = cy.Pair(
        ...     gear_teeth=39, pin_circle_radius="66 mm", pin_radius="3 mm", eccentricity="1.3 mm", face_width="10 mm"
        ... ).replace(offset="-50 um", isometric="-30 um")
        >>> run = cy.Drive(pair).wear(WearLaw(pins="free", coefficient="1e-20 m^2/N"), "-400 N*m", 1e5, workers=1)
        >>> 0.0 < run.figures["updated"]["gear_depth_max"] < 1e-6
        True
        """
        from cycloid_fmu.wear.law import Load, WearLaw, read_wear_law
        from cycloid_fmu.wear.life import run_wear

        refuse_first_stage(self, "wear")
        source = "law" if isinstance(law, WearLaw) else str(law)
        stated = law if isinstance(law, WearLaw) else read_wear_law(law)
        loads = (Load(torque=_torque(torque), crank_turns=1.0),)
        return run_wear(self.stage, stated, loads, crank_turns, source, workers=_cores(workers), progress=progress)

    def at_age(self, age: float | str, wear_factor: float = 1.0) -> Self:
        """Return this drive at an age of its forecast: flanks, pins and the clearance of the bearing that wears.

        Parameters
        ----------
        age
            Running time since new, s or text with a unit, `"5000 h"`.
        wear_factor
            Ratio of the wear coefficient to the forecast's median.

        Raises
        ------
        edge.InputError
            If the drive has no forecast (`fitting`'s `Forecast.aged`), or the values are outside of it.
        """
        from cycloid_fmu.surfaces.surface import at_age

        found = at_age(self.pair.nominal, self.surface, _quantity("age", age, "s"), wear_factor)
        return type(self)(*found, self.first_stage)

    def after(self, crank_turns: float) -> Self:
        """Return this worn drive after a number of crank turns since new, linear between the states of its life.

        Raises
        ------
        edge.ArgumentError
            If the drive has no life (`WearRun.surface`), or its life ends earlier.
        """
        from cycloid_fmu.surfaces.surface import surface_after

        worn = surface_after(self.surface, crank_turns)
        return type(self)(self.pair.nominal, worn.replace(life=None), self.first_stage)

    def design(
        self,
        goals: str | Sequence[str],
        vary: Mapping[str, tuple[float | str, float | str]],
        *,
        limits: Mapping[str, Any] | None = None,
        duty: Sequence[Mapping[str, Any]] = (),
        tolerances: Tolerances | str | os.PathLike[str] | None = None,
        required_yield: float = 0.99,
        starts: int = 4,
        points: int = 7,
        seed: int = 1,
        progress: Callable[[str], None] = lambda step: None,
    ) -> list[Design]:
        """Search for the geometry and modification that meet the limits and optimize one goal, or two.

        Parameters
        ----------
        goals
            A figure or size to optimize, or two for a Pareto front (`cycloid_fmu.studies.design.GOALS`).
        vary
            {name: (lowest, highest)} of `cycloid_fmu.studies.design.VARIABLES`, SI or text with a unit; all other
            values are fixed.
        limits, duty
            Requirements as in a requirements file; the torques are those of the duty, or the rated torque.
        tolerances, required_yield
            With tolerances, this share of the drives within them must meet the limits; otherwise the drive as drawn
            must.
        starts, seed
            Starting points besides this drive; the same seed gives the same result.
        points
            Number of drives on a Pareto front.
        progress
            Called with the name of each stage.

        Returns
        -------
        designs
            One design, or those of the Pareto front.

        Raises
        ------
        edge.InputError
            If a name or range is wrong, there is no torque, or no drive can be made within the ranges.

        Examples
        --------
        The offset with the smallest play for a given isometric modification:

        >>> import cycloid_fmu as cy
        >>> pair = cy.Pair(
        ...     gear_teeth=39, pin_circle_radius="64 mm", pin_radius="3 mm", eccentricity="1.3 mm", face_width="10 mm",
        ...     rated_torque="181 N*m",
        ... )
        >>> drive = cy.Drive(pair).replace(isometric="-15 um")
        >>> (found,) = drive.design("backlash", {"offset": ("-60 um", "0 um")}, limits={"interference": "0.1 um"})
        >>> round(found.values["offset"] * 1e6, 1), found.met
        (-25.6, True)
        """
        from cycloid_fmu.studies.design import DesignTask, search

        refuse_first_stage(self, "a search")
        if self.pair.errors or self.surface != surface_of_pair(self.pair):
            raise edge.ArgumentError("drive", "has errors; a search needs the drive as drawn: give it without errors")
        task = DesignTask(
            goals=(goals,) if isinstance(goals, str) else tuple(goals),
            vary=dict(vary),
            limits=dict(limits or {}),
            duty=tuple(duty),
            robust=None if tolerances is None else {"yield": required_yield},
        )
        allowed = None if tolerances is None else _tolerances(tolerances)
        return search(self.pair, task, allowed, starts=starts, points=points, seed=seed, progress=progress)

    def build_fmu(
        self,
        path: str | os.PathLike[str],
        interface: Literal["kinematic", "compliant"] | Interface = "kinematic",
        *,
        fmi_version: Literal["2.0", "3.0"] = "2.0",
        native: bool = False,
        largest_torque: float | None = None,
    ) -> None:
        """Build an FMU of the drive; never a partial file. `cycloid_fmu.build_fmus` builds those of several drives.

        A drive with a life is built at the age of its surface; `at_age` and `after` return it at others.

        Parameters
        ----------
        path
            The FMU file.
        interface
            "kinematic" takes crank motion and load and gives the output's motion; "compliant" takes both motions and
            gives both torques; an `Interface` has inertia, friction and losses as well.
        fmi_version
            "2.0" or "3.0".
        native
            Whether to build an FMU from C code and tables that needs no Python, instead of the exact model; needs the
            extra `native`.
        largest_torque
            Largest torque of a native FMU's tables, N·m; None for 2.5 times the rated torque.

        Raises
        ------
        edge.InputError
            If the folder does not exist, or the interface is not available for this drive.

        Examples
        --------
        >>> import cycloid_fmu as cy
        >>> pair = cy.Pair(
        ...     gear_teeth=39, pin_circle_radius="64 mm", pin_radius="3 mm", eccentricity="1.3 mm", face_width="10 mm"
        ... )
        >>> drive = cy.Drive(pair)
        >>> drive.build_fmu("drive.fmu")
        >>> run = cy.simulate_fmu("drive.fmu", crank_angle=[0.0, 0.1], torque=100.0)
        >>> bool(abs(run["transmission_error"] - drive.analyze(100.0, crank_angle=[0.0, 0.1])
        ...          .transmission_error.values[0]).max() < 1e-12)
        True
        """
        if native:
            from cycloid_fmu.fmu.native import build_native

            build_native(
                self,
                path,
                interface=interface,
                fmi_version=fmi_version,
                largest_torque=largest_torque,
                workers=_cores(),
            )
        else:
            from cycloid_fmu.fmu.build import build_fmu

            build_fmu(self, path, interface=interface, fmi_version=fmi_version)

    def joint(
        self,
        *,
        files: Sequence[str | os.PathLike[str]] = (),
        stated: Mapping[str, Any] | None = None,
        tolerances: Tolerances | str | os.PathLike[str] | None = None,
        draws: int | None = None,
        seed: int = 0,
        orders: int = 5,
        angles: int | None = None,
        series_compliance: float | str = 0.0,
        motor_speed: float | str = 100.0,
        workers: int | None = None,
        progress: Callable[[int], None] = lambda drives: None,
    ) -> Joint:
        """Return the drive as a joint of a robot simulator: play, stiffness, orders, friction, each with its origin.

        Parameters
        ----------
        files
            Files with numbers that replace the drive's own: stated or measured ones (cycloid-joint-figures/1), figures
            of a loop (`cycloid-fit metrics -o`), friction (cycloid-friction/1, or `cycloid-fit friction -o` as JSON).
        stated
            Numbers by dotted name, such as `{"rotor_inertia": "1e-4 kg*m^2"}`, which replace those of the files.
        tolerances
            Tolerances, or their file, within which drives are drawn; without them from the covariance of a fit.
        draws, seed
            Number of draws, by default 100 where there are tolerances or a fit; and their seed.
        orders
            Number of orders of the transmission error, and of the play, that are kept.
        angles
            Crank angles over one turn of the output; None for as many as the orders need.
        series_compliance
            Compliance in series with the drive, rad/(N·m) or text; 0 for that up to a catalogue's stiffness.
        motor_speed
            Speed of the motor at which the efficiencies of `[losses]` are taken, rad/s or text with a unit.
        workers, progress
            Number of threads; function called with 1 for each drive that was just solved.

        Returns
        -------
        cycloid_fmu.joint.document.Joint
            The joint; `cycloid_fmu.joint.files.write_files` writes it for a simulator.

        Raises
        ------
        edge.InputError
            If the drive has no rated torque, a file can't be read or a number is out of range.

        Examples
        --------
        >>> import cycloid_fmu as cy
        >>> pair = cy.Pair(
        ...     gear_teeth=39, pin_circle_radius="64 mm", pin_radius="3 mm", eccentricity="1.3 mm", face_width="10 mm",
        ...     rated_torque="181 N*m",
        ... )
        >>> joint = cy.Drive(pair).replace(offset="-20 um").joint(angles=90)
        >>> round(joint.numbers["play"]["value"] * cy.ARCSEC), joint.numbers["rotor_inertia"]["reason"]
        (95, 'not stated; a pair file has no motor')
        """
        from cycloid_fmu.joint.of_parts import Settings, joint_of

        settings = Settings(
            tolerances=None if tolerances is None else _tolerances(tolerances),
            draws=draws,
            seed=seed,
            orders=orders,
            angles=angles,
            series_compliance=_quantity("series_compliance", series_compliance, "rad/(N*m)"),
            speed=_quantity("motor_speed", motor_speed, "rad/s"),
            workers=workers or os.cpu_count() or 1,
            progress=progress,
        )
        return joint_of(self, files, stated, settings)

    def compensator(
        self,
        *,
        friction: Friction | None = None,
        stiffness: float | str | None = None,
        series_compliance: float = 0.0,
        temperatures: tuple[float | str, float | str] | None = None,
        torque_accuracy: float | str | None = None,
        torque_share: float = 0.05,
        largest_torque: float | str | None = None,
        residual: float | str = "0.5 arcsec",
        sensor: float | str = "1 arcsec",
        tolerances: Tolerances | str | os.PathLike[str] | None = None,
        workers: int | None = None,
        total: Callable[[int], None] = lambda angles: None,
        progress: Callable[[int], None] = lambda angles: None,
    ) -> Compensator:
        """Return the compensator of the drive, which gives the motor angle for a desired output angle.

        Parameters
        ----------
        friction
            Friction at the output; the torque through the teeth is the load without it.
        stiffness, series_compliance
            Stiffness of the whole drive (N·m/rad), or compliance in series with it (rad/(N·m)), as for an `Interface`.
        temperatures
            Temperature range of the table, the same for all bodies, K or text with a unit; None for the pair's
            temperatures.
        torque_accuracy
            Standard deviation of the load torque given by the controller, N·m; None for 1 % of the rated torque. The
            change from one flank to the other is spread over this range.
        torque_share
            Standard deviation of that torque's scale factor, dimensionless; its effect on the wind-up is part of the
            band.
        largest_torque
            Largest torque of the table, N·m; None for 2.5 times the rated torque.
        residual
            Largest error of the table, rad; the smallest table within it is used.
        sensor
            Standard deviation of an output encoder, rad.
        tolerances
            Tolerances, or their file, if the compensator is used for any drive within them: the band then includes the
            scatter of these drives about this one. Otherwise the band is that of this drive, with the uncertainty of
            its fit.
        workers, total, progress
            Number of threads; functions called with the total number of solutions, and with the number just finished.

        Returns
        -------
        cycloid_fmu.compensation.compensator.Compensator
            The compensator; its method `step` is one step of a controller.

        Raises
        ------
        edge.InputError
            If a default needs a missing rated torque, a number is out of range, or the period of the drive is too long.

        Examples
        --------
        >>> import cycloid_fmu as cy
        >>> pair = cy.Pair(
        ...     gear_teeth=39, pin_circle_radius="64 mm", pin_radius="3 mm", eccentricity="1.3 mm", face_width="10 mm",
        ...     rated_torque="181 N*m",
        ... )
        >>> drive = cy.Drive(pair).replace(offset="-20 um", errors={"eccentricity": "5 um"})
        >>> compensator = drive.compensator()
        >>> memory = compensator.start(0.0)
        >>> command = compensator.step(memory, 0.1, 0.0, load_torque=100.0, temperature=293.15)
        >>> found = drive.analyze(100.0, crank_angle=[command.motor_angle])
        >>> output = command.motor_angle / drive.ratio + float(found.transmission_error[0, 0])
        >>> bool(abs(output - 0.1) < 0.5 / 206265)
        True
        """
        from cycloid_fmu.compensation.build import drive_compensator

        given = {
            "stiffness": (stiffness, "N*m/rad"),
            "torque_accuracy": (torque_accuracy, "N*m"),
            "largest_torque": (largest_torque, "N*m"),
            "residual": (residual, "rad"),
            "sensor": (sensor, "rad"),
        }
        values = {
            name: None if value is None else _quantity(name, value, unit) for name, (value, unit) in given.items()
        }
        between = temperatures and tuple(_quantity("temperatures", one, "K") for one in temperatures)
        return drive_compensator(
            self,
            self.ratio,
            friction=friction,
            temperatures=between,
            series_compliance=series_compliance,
            torque_share=torque_share,
            workers=_cores(workers),
            tolerances=None if tolerances is None else _tolerances(tolerances),
            total=total,
            progress=progress,
            **values,
        )

    def profile(self, *, disc: int = 0, chord_error: float | str = 1e-7) -> Profile:
        """Return a disc as made for CAD, CAM and measuring machines: outline in arcs, holes, pins and pin circle.

        Parameters
        ----------
        disc
            Number of the disc, from 0.
        chord_error
            Largest distance of the flank from its arcs, m or text with a unit.

        Returns
        -------
        Profile
            At 20 °C, in the disc's frame; its method `write` writes DXF, SVG, CSV or STEP by the ending of the name.

        Raises
        ------
        edge.InputError
            If there is no such disc, the chord error is out of range or a hole cuts the flank.

        Examples
        --------
        >>> import cycloid_fmu as cy
        >>> pair = cy.Pair(
        ...     gear_teeth=39, pin_circle_radius="64 mm", pin_radius="3 mm", eccentricity="1.3 mm", face_width="10 mm"
        ... )
        >>> profile = cy.Drive(pair).profile(chord_error="0.05 um")
        >>> profile.largest_error <= 5e-8, round(profile.area * 1e6)
        (True, 11693)
        >>> profile.write("disc.svg")
        """
        from cycloid_fmu.cad.profile import profile_of

        return profile_of(self.stage, disc, _quantity("chord_error", chord_error, "m"))

    def write(self, path: str | os.PathLike[str]) -> None:
        """Write the drive: a pair file (`.toml`), or an error surface (`.nc`) with form and wear as well.

        Raises
        ------
        edge.InputError
            If the name has another ending, or a pair file can't store the drive's form and wear.
        """
        from cycloid_fmu.geometry.pair import write_pair
        from cycloid_fmu.surfaces.files import write_surface
        from cycloid_fmu.surfaces.surface import DEVIATIONS

        target = edge.output_path(path, "path", (".toml", ".nc"))
        if target.suffix.lower() == ".nc":
            write_surface(self.surface, target)
        elif any(getattr(self.surface, name) is not None for name in DEVIATIONS):
            raise edge.InputError(f"{path}: a pair file can't hold the form of flanks and pins; write a surface, .nc.")
        else:
            write_pair(self.pair, target)


def build_fmus(
    drives: Iterable[Drive],
    path: str | os.PathLike[str],
    interface: Literal["kinematic", "compliant"] | Interface = "kinematic",
    **options: Any,
) -> list[Path]:
    """Build an FMU of each drive: those drawn from a fit, a worn drive at several ages, or the drives of a study.

    Parameters
    ----------
    drives
        The drives.
    path
        `drive.fmu` for the files `drive-0000.fmu`, `drive-0001.fmu`, …, in the order of the drives. Files of the same
        names are replaced.
    interface, options
        As in `Drive.build_fmu`; the same for all.

    Returns
    -------
    paths
        The files.

    Raises
    ------
    edge.InputError
        As `Drive.build_fmu` does.

    Examples
    --------
    Drives that agree with the measurements as well as an identified one:

    >>> import cycloid_fmu as cy, fitting, numpy as np
    >>> pair = cy.Pair(gear_teeth=9, pin_circle_radius=0.04, pin_radius=0.004, eccentricity=0.002, face_width=0.01)
    >>> fitted = cy.Drive(pair).surface.replace(covariance=np.array([[1e-12]]), covariance_of=("eccentricity",))
    >>> drawn = fitting.ensemble(cy.Drive(pair, fitted), count=2)
    >>> [path.name for path in cy.build_fmus(drawn, "drawn.fmu")]
    ['drawn-0000.fmu', 'drawn-0001.fmu']
    """
    built = []
    for number, drive in enumerate(drives):
        built.append(numbered(path, number))
        drive.build_fmu(built[-1], interface, **options)
    return built


def numbered(path: str | os.PathLike[str], number: int) -> Path:
    """Return the path with a number in its name: `drive-0001.fmu`."""
    whole = Path(path)
    return whole.with_name(f"{whole.stem}-{number:04d}{whole.suffix}")


def refuse_first_stage(drive: Drive, what: str) -> None:
    """Raise an `edge.InputError` for a drive with a first stage if `what` supports only the cycloid stage."""
    if drive.first_stage is not None:
        problem = f"has the first stage of an RV reducer, which {what} does not take into account yet"
        raise edge.ArgumentError("drive", f"{problem}; give only its pair")


def read_drive(path: str | os.PathLike[str], surface: str | os.PathLike[str] | None = None) -> Drive:
    """Return the drive of a pair file or a reducer file, with its stated errors or those of an error surface.

    If a reducer file contradicts itself, an `edge.InputWarning` states the values used.

    Raises
    ------
    edge.InputError
        If a file can't be read, the surface belongs to another pair, or a drive with these errors can't exist; it names
        the file, the field and the value.

    Examples
    --------
    >>> import cycloid_fmu as cy
    >>> pair = cy.Pair(
    ...     gear_teeth=39, pin_circle_radius="64 mm", pin_radius="3 mm", eccentricity="1.3 mm", face_width="10 mm"
    ... )
    >>> drive = cy.Drive(pair).replace(errors={"pin_radial": {2: ("2.5 um", "40 deg")}})
    >>> drive.write("drive.toml")
    >>> cy.read_drive("drive.toml") == drive
    True
    """
    from cycloid_fmu.reducer.drive_file import parts_of_file
    from cycloid_fmu.surfaces.files import read_surface

    pair, made, first_stage = parts_of_file(path)
    if surface is not None:
        made = read_surface(surface)
        check_surface(pair, made, str(path), str(surface))
        dimensions(pair, made, f"{surface}: errors")
    return Drive(pair, made, first_stage)


def field_units(data: xr.Dataset) -> xr.Dataset:
    """Return a dataset in the units of drawings and reports: arcsec, N·m/arcmin, MPa and µm instead of SI.

    Crank angles are in degrees.

    Examples
    --------
    >>> import cycloid_fmu as cy
    >>> pair = cy.Pair(
    ...     gear_teeth=39, pin_circle_radius="64 mm", pin_radius="3 mm", eccentricity="1.3 mm", face_width="10 mm"
    ... )
    >>> data = cy.field_units(cy.Drive(pair).analyze(181, angles=45))
    >>> data.transmission_error.attrs["units"], round(float(data.transmission_error.mean()), 1)
    ('arcsec', 4.5)
    """
    found = data.copy()
    for name in data.variables:
        unit = str(data[name].attrs.get("units"))
        shown, factor = ("deg", 180.0 / math.pi) if name == "crank_angle" else FIELD_UNITS.get(unit, (unit, 1.0))
        if shown != unit:
            found[name] = (data[name].dims, data[name].values * factor, {**data[name].attrs, "units": shown})
    return found
