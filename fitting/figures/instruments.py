"""The instruments of a bench, their file and their standard uncertainties."""

from __future__ import annotations

import datetime
import math
import os
from typing import Annotated, Literal, Self

import pydantic

from cycloid_fmu import edge
from fitting.figures.figure import unit_of_figure

FORMAT = "cycloid-instruments/1"
Distribution = Literal["rectangular", "normal", "arcsine"]
_Angle = Annotated[edge.Angle, pydantic.Field(ge=0.0)]
_Torque = Annotated[edge.Torque, pydantic.Field(ge=0.0)]


def standard_uncertainty(limit: float, distribution: Distribution) -> float:
    """Return the standard uncertainty of a quantity within ±a, `limit` (JCGM 100:2008, 4.3), in the limit's unit.

    Rectangular: a/√3; arcsine, a wave of amplitude a and unknown phase: a/√2; normal: a/2, with a the expanded
    uncertainty of a calibration with k = 2.

    Examples
    --------
    >>> [round(standard_uncertainty(1.0, kind), 4) for kind in ("rectangular", "arcsine", "normal")]
    [0.5774, 0.7071, 0.5]
    """
    return limit / {"rectangular": math.sqrt(3.0), "arcsine": math.sqrt(2.0), "normal": 2.0}[distribution]


class Instrument(edge.Config):
    """Certificate data of an instrument.

    Attributes
    ----------
    name, serial_number
        Maker and type, and serial number.
    calibrated
        Date of the calibration, such as 2026-03-01.
    """

    name: str = ""
    serial_number: str = ""
    calibrated: datetime.date | None = None


class Encoder(Instrument):
    """An angle encoder as mounted.

    Attributes
    ----------
    name, serial_number, calibrated
        Maker and type, serial number, and date of the calibration, such as 2026-03-01.
    accuracy
        Largest graduation error over a turn, ±, rad or text; assumed to be a wave of the shaft's first order.
    distribution
        Distribution of the accuracy: "rectangular" for the limits of a data sheet, "normal" for the expanded
        uncertainty of a calibration with k = 2.
    resolution
        Angle of one step, rad or text.
    subdivision
        Amplitude of the error within a signal period, rad or text.
    periods_per_turn
        Signal periods per turn.
    run_out
        Amplitude of the angle error from eccentric mounting and coupling, rad or text, a wave of the shaft's first
        order.
    """

    accuracy: _Angle = 0.0
    distribution: Literal["rectangular", "normal"] = "rectangular"
    resolution: _Angle = 0.0
    subdivision: _Angle = 0.0
    periods_per_turn: Annotated[int, pydantic.Field(gt=0)] | None = None
    run_out: _Angle = 0.0

    @pydantic.model_validator(mode="after")
    def _has_periods(self) -> Self:
        if self.subdivision > 0.0 and self.periods_per_turn is None:
            raise ValueError("subdivision needs periods_per_turn, the signal periods per turn")
        return self


class TorqueSensor(Instrument):
    """A torque sensor.

    Attributes
    ----------
    name, serial_number, calibrated
        Maker and type, serial number, and date of the calibration, such as 2026-03-01.
    range
        Nominal torque of the sensor, N·m or text.
    accuracy_class
        Largest error at the rated torque, percent of the range (rectangular); it is proportional to the torque.
    zero
        Largest zero error, ±, N·m or text (rectangular).
    """

    range: Annotated[edge.Torque, pydantic.Field(gt=0.0)]
    accuracy_class: Annotated[float, pydantic.Field(ge=0.0, lt=100.0)]
    zero: _Torque = 0.0


class Thermometer(Instrument):
    """Uncertainty of the drive's temperature, and its effect on the figures.

    Attributes
    ----------
    name, serial_number, calibrated
        Maker and type, serial number, and date of the calibration, such as 2026-03-01.
    limit
        Largest difference of the drive's temperature from the stated one, ±, such as "1 K" (rectangular).
    coefficients
        {figure: its change with temperature}, text such as "0.5 arcsec/K".
    """

    limit: Annotated[edge.Temperature, pydantic.Field(ge=0.0, le=100.0)]
    coefficients: dict[str, str] = pydantic.Field(default_factory=dict)

    @pydantic.field_validator("coefficients")
    @classmethod
    def _of_figures(cls, given: dict[str, str]) -> dict[str, str]:
        for name, value in given.items():
            unit = f"{unit_of_figure(name)}/K"
            try:
                edge.parse_quantity(value, unit)
            except ValueError as problem:
                raise ValueError(f"{name}: {problem}") from None
        return given

    def coefficient(self, name: str) -> float:
        """Return the change of a figure with temperature, SI unit per K; 0 if not stated."""
        stated = self.coefficients.get(name)
        return 0.0 if stated is None else edge.parse_quantity(stated, f"{unit_of_figure(name)}/K")


class Instruments(edge.Config):
    """The instruments of a bench; budgets do not include instruments that are not stated.

    Attributes
    ----------
    input_encoder, output_encoder
        Angle encoders of the input and output shafts.
    torque_sensor, input_torque_sensor
        Torque sensors on the output and on the input.
    thermometer
        Thermometer for the drive's temperature.
    """

    input_encoder: Encoder | None = None
    output_encoder: Encoder | None = None
    torque_sensor: TorqueSensor | None = None
    input_torque_sensor: TorqueSensor | None = None
    thermometer: Thermometer | None = None

    @property
    def stated(self) -> dict[str, Instrument]:
        """The stated instruments, by the measured quantity."""
        return {name: instrument for name in type(self).model_fields if (instrument := getattr(self, name)) is not None}


class InstrumentsFile(edge.Config):
    """Instruments of a bench, for the uncertainty budget of its figures."""

    instruments: Instruments


def read_instruments(path: str | os.PathLike[str]) -> Instruments:
    """Read the instruments of a bench from a TOML file, `cycloid-instruments/1`.

    Raises
    ------
    edge.InputError
        If the file can't be read or is invalid; one sentence for each problem.

    Examples
    --------
    >>> import pathlib
    >>> _ = pathlib.Path("instruments.toml").write_text(
    ...     'format = "cycloid-instruments/1"' + chr(10) + '[instruments.output_encoder]' + chr(10)
    ...     + 'accuracy = "2 arcsec"' + chr(10))
    >>> list(read_instruments("instruments.toml").stated)
    ['output_encoder']
    """
    return edge.validated(
        InstrumentsFile, edge.toml_table(edge.read_text(path, FORMAT), FORMAT, str(path)), str(path)
    ).instruments
