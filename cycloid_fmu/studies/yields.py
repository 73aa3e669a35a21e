"""A complete tolerance study: read, check, solve, write, and its yields."""

from __future__ import annotations

import dataclasses
import math
import os
import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from cycloid_fmu import edge
from cycloid_fmu.analysis import series_compliance, solve, step_notes, tilt_notes
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.reducer.drive_file import parts_of_file
from cycloid_fmu.studies import limits as judging
from cycloid_fmu.studies.checkpoint import Checkpoint, checkpoint_of, reserved
from cycloid_fmu.studies.friction import FIGURES
from cycloid_fmu.studies.tolerance import (
    PER_TORQUE,
    Array,
    Result,
    Study,
    check_study,
    crank_angles,
    dataset_of,
    friction_of,
    run,
    sobol_indices,
    statistics,
    surface_of,
    yields,
)
from cycloid_fmu.surfaces.sampling import read_tolerances
from cycloid_fmu.surfaces.surface import nominal_surface


@dataclasses.dataclass(frozen=True)
class Findings:
    """The findings of a study.

    Attributes
    ----------
    result
        The solved samples.
    statistics, yields, indices
        As `tolerance.statistics`, `yields` and `sobol_indices` return them; no indices but with Saltelli's design.
    """

    result: Result
    statistics: Mapping[str, Mapping[str, Any]]
    yields: Mapping[str, Mapping[str, float]]
    indices: Mapping[str, Mapping[str, Array]]

    def numbers(self) -> dict[str, Any]:
        """Return the figures in SI units, for scripts."""
        return {
            "samples": self.result.sample.size,
            "torque": list(self.result.study.torque),
            "factors": self.result.study.factors,
            "statistics": self.statistics,
            "yields": self.yields,
            "indices": self.indices,
        }


def read_study(
    pair_file: str | os.PathLike[str],
    tolerances_file: str | os.PathLike[str],
    torque: Sequence[float] | None = None,
    requirements: tuple[judging.Requirements, str] | None = None,
    **settings: Any,
) -> Study:
    """Return the study of a pair file and a tolerance file, checked.

    Stated errors of the drive are no part of it, which an `edge.InputWarning` says.

    Parameters
    ----------
    torque
        Loads on the output, N·m; plus and minus the pair's rated torque where None.
    requirements
        Requirements and the name of their file, whose limits are judged in place of those of the tolerance file.
    settings
        Further fields of `Study`.

    Raises
    ------
    edge.InputError
        If a file can't be read, there is neither a torque nor a rated torque, both files state limits, or the study is
        one that `check_study` refuses.
    """
    (pair, surface, first_stage), tolerances = parts_of_file(pair_file), read_tolerances(tolerances_file)
    if surface != nominal_surface(pair):
        left_out = "its errors are no part of the study, whose drives have those within the tolerances alone."
        warnings.warn(f"{pair_file}: {left_out}", edge.InputWarning, stacklevel=2)
    if not torque:
        rated = pair.rated_load(str(pair_file))
        torque = (rated, -rated)
    study = Study(pair, tolerances, torque=tuple(torque), first_stage=first_stage, **settings)
    if requirements is not None:
        asked, source = requirements
        if tolerances.limits.stated():
            raise edge.InputError(
                f"{tolerances_file}: [limits] is stated here and in {source}; state the limits in one of them."
            )
        study = with_requirements(study, asked)
    check_study(study, str(pair_file), str(tolerances_file))
    return study


def notes_of(study: Study) -> list[str]:
    """Return where drives within the tolerances lie outside what the model is made for, one sentence each."""
    stated = (getattr(study.tolerances, f"misalignment_{plane}", None) for plane in ("xz", "yz"))
    tilt = math.hypot(*(one.tolerance for one in stated if one is not None))
    return [
        *tilt_notes(study.drive, tilt, "The tolerances permit a gear's axis that is tilted by"),
        *step_notes(study.pair.pins, study.angles, study.turns),
    ]


def with_requirements(study: Study, asked: judging.Requirements) -> Study:
    """Return a study that judges requirements as far as it has their figures, those of friction if it is stated."""
    limits, pair = asked.limits.of_study, study.pair
    if pair.losses is None or pair.supports is None:
        limits = limits.replace(**dict.fromkeys(FIGURES))
    return dataclasses.replace(study, tolerances=study.tolerances.replace(limits=limits), duty=asked.duty)


def judged(result: Result) -> list[judging.Verdict]:
    """Return the verdicts on a study: a limit is met if every drive meets it.

    The value is that of the worst drive, `sample` its number, and the place is found by solving it once more.
    """
    study, angle, found = result.study, crank_angles(result.study), []
    for name, limit in study.tolerances.limits.stated().items():
        values = result.values[:, [n == name for n, _ in study.columns]].max(axis=1)
        row = int(values.argmin() if judging.is_lower(name, limit) else values.argmax())
        surface = surface_of(study, result.point[row])
        only = judging.Limits().replace(**{name: limit})
        if name in study.friction:
            (worst,) = judging.judge_friction(only, study.driven, angle, friction_of(study, surface))
            found.append(dataclasses.replace(worst, where={"sample": int(result.sample[row]), **worst.where}))
            continue
        loads = study.torque if name in PER_TORQUE else study.pair.lost_motion_loads
        again = solve(DriveValue(study.pair, surface, study.first_stage), loads, angle, with_stiffness=False)
        data = {**vars(again), "backlash": again.backlash}
        if name == "lost_motion":
            data["lost_motion"] = again.transmission_error[0] - again.transmission_error[1]
        series = series_compliance(study.drive)
        (place,) = judging.judge(only, study.pair, data, series)
        where = {"sample": int(result.sample[row]), **place.where}
        found.append(judging.verdict(name, float(values[row]), limit, where, place.basis))
    return found


def conduct(
    study: Study,
    output: str | os.PathLike[str] | None = None,
    *,
    workers: int = 1,
    scheduler: str | None = None,
    progress: Callable[[int], None] = lambda drives: None,
) -> Findings:
    """Solve a study, write it and return its figures.

    Parameters
    ----------
    output
        A netCDF file, format `cycloid-tolerance-study/1`. Until it is written, solved samples are kept in `output` with
        `.checkpoint` appended; the same study continues from there.
    workers, scheduler, progress
        As of `tolerance.run`.

    Raises
    ------
    edge.InputError
        If the checkpoint is of another study.
    KeyboardInterrupt
        Its text states the kept results.
    """
    kept = None
    with reserved(output):
        if output is not None:
            kept = Checkpoint(checkpoint_of(output), study)
        result = run(study, kept, workers=workers, scheduler=scheduler, progress=progress)
        if output is not None:
            edge.write_netcdf(dataset_of(result), output)
    indices = sobol_indices(result) if study.design == "saltelli" else {}
    return Findings(result, statistics(result), yields(result), indices)
