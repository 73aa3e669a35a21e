"""Configuration: models whose quantities have units, and whose errors name file, field, value and allowed values."""

from __future__ import annotations

import math
import numbers
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Any, Self, TypeVar, get_args, get_origin

import pydantic

from cycloid_fmu.edge.problems import ArgumentError, InputError, cut, did_you_mean, shown
from cycloid_fmu.edge.quantities import EXAMPLES, parse_quantity

if TYPE_CHECKING:
    from pydantic._internal._model_construction import ModelMetaclass as _Construction
else:

    class _Construction(type(pydantic.BaseModel)):
        """Construction in Python raises an `InputError` with one sentence per problem, as reading a file does."""

        def __call__(cls, *args: Any, **values: Any) -> Any:
            try:
                return super().__call__(*args, **values)
            except pydantic.ValidationError as problems:
                raise cls._refusal(problems) from None


def quantity(value: object, si: str, info: pydantic.ValidationInfo | None = None) -> float:
    """Return a quantity in SI units, given as text with its unit; from Python, a number in SI units is accepted too.

    Parameters
    ----------
    value
        The given value.
    si
        The SI unit, as pint writes it: "m", "rad", "N*m".
    info
        Pydantic's validation information; its context states whether the value is from a file (`validated`). None for
        values from Python.

    Raises
    ------
    ValueError
        If it is neither; the message shows the correct form.
    """
    in_file = info is not None and info.context is not None
    if not in_file and isinstance(value, numbers.Real) and not isinstance(value, bool):
        if not math.isfinite(number := float(value)):
            raise ValueError(f'give a finite number in SI units, or text with a unit, such as "{EXAMPLES[si]}"')
        return number
    return parse_quantity(value, si)


def _in_unit(si: str) -> tuple[pydantic.BeforeValidator, Any]:
    def read(value: Any, info: pydantic.ValidationInfo) -> float:
        return quantity(value, si, info)

    return pydantic.BeforeValidator(read), pydantic.Field(json_schema_extra={"quantity": EXAMPLES[si], "si": si})


Length = Annotated[float, *_in_unit("m")]
Angle = Annotated[float, *_in_unit("rad")]
Torque = Annotated[float, *_in_unit("N*m")]
Pressure = Annotated[float, *_in_unit("Pa")]
Force = Annotated[float, *_in_unit("N")]
Stiffness = Annotated[float, *_in_unit("N/m")]
TorsionalStiffness = Annotated[float, *_in_unit("N*m/rad")]
RotationalDamping = Annotated[float, *_in_unit("N*m*s/rad")]
Seconds = Annotated[float, *_in_unit("s")]
Speed = Annotated[float, *_in_unit("rad/s")]
Velocity = Annotated[float, *_in_unit("m/s")]
PowerDensity = Annotated[float, *_in_unit("W/m^2")]
Temperature = Annotated[float, *_in_unit("K")]
ThermalExpansion = Annotated[float, *_in_unit("1/K")]
TemperatureCoefficient = Annotated[float, *_in_unit("1/K")]
PressureViscosity = Annotated[float, *_in_unit("1/Pa")]
KinematicViscosity = Annotated[float, *_in_unit("m^2/s")]
ThermalResistance = Annotated[float, *_in_unit("K/W")]
HeatTransfer = Annotated[float, *_in_unit("W/(m^2*K)")]
HeatCapacity = Annotated[float, *_in_unit("J/K")]
Area = Annotated[float, *_in_unit("m^2")]
WearCoefficient = Annotated[float, *_in_unit("m^2/N")]


_COUNT = re.compile(r"\w+ should have (at \w+ \d+) items? after validation, not (\d+)")
_DEEPEST, _MOST_TABLES = 4, 5  # tables in tables; tables that a sentence lists
_LIST = "a list in square brackets"
_NUMBER = "a number without quotes"
_WORDS = {
    "list_type": _LIST,
    "tuple_type": _LIST,
    "dict_type": "a table",
    "model_type": "a table",
    "float_type": _NUMBER,
    "float_parsing": _NUMBER,
    "string_type": "text in quotes",
}
"""Expected entries for pydantic's error types, in TOML's terms."""


class Config(pydantic.BaseModel, metaclass=_Construction):
    """Base class of data from TOML: unknown keys are refused, instances are immutable.

    Raises
    ------
    InputError
        If a value is invalid; one sentence per problem.
    """

    model_config = pydantic.ConfigDict(extra="forbid", frozen=True, validate_default=False)

    @classmethod
    def _refusal(cls, problems: pydantic.ValidationError) -> InputError:
        return _input_error(problems, cls, cls.__name__)

    def replace(self, **changes: Any) -> Self:
        """Return a copy with changed values, validated as in construction."""
        return type(self)(**{**{name: getattr(self, name) for name in type(self).model_fields}, **changes})

    def model_copy(self, *, update: Mapping[str, Any] | None = None, deep: bool = False) -> Self:
        """As `replace`, so that no copy skips validation."""
        return self.replace(**(update or {}))


class Arguments(Config):
    """Base class of the arguments of a function, which may also be the options of a command.

    Raises
    ------
    ArgumentError
        If a value is invalid; a command line shows its option.
    """

    @classmethod
    def _refusal(cls, problems: pydantic.ValidationError) -> InputError:
        first = problems.errors(include_url=False)[0]
        of_validator = first.get("ctx", {}).get("error")
        if isinstance(of_validator, ArgumentError):
            return of_validator
        if len(first["loc"]) != 1 or first["type"] == "extra_forbidden":
            return super()._refusal(problems)
        name = str(first["loc"][0])
        if first["type"] == "missing":
            return ArgumentError(name, "is missing")
        return ArgumentError(name, _allowed(first), first["input"])


Model = TypeVar("Model", bound=Config)


def unit_of_field(field: Any) -> str | None:
    """Return the SI unit of a model's field; None if it has none."""
    if isinstance(extra := getattr(field, "json_schema_extra", None), dict) and "si" in extra:
        return str(extra["si"])
    parts = [*get_args(getattr(field, "annotation", field)), *getattr(field, "__metadata__", ())]
    return next((unit for part in parts if (unit := unit_of_field(part)) is not None), None)


def _models(annotation: Any) -> Iterator[type[pydantic.BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, pydantic.BaseModel):
        yield annotation
    for part in get_args(annotation):
        yield from _models(part)


def _keys(model: type[pydantic.BaseModel], place: Sequence[int | str]) -> list[str]:
    """Return the valid keys at a location in a model."""
    models = [model]
    for part in place:
        fields = [m.model_fields[part] for m in models if isinstance(part, str) and part in m.model_fields]
        models = [below for f in fields for below in _models(f.annotation)] or models
    return [field.alias or name for one in models for name, field in one.model_fields.items()]


def _tables_with(model: type[pydantic.BaseModel], key: str, table: str) -> str:
    """Return "it belongs to …" with the tables of a file that have a key, or "" if none has it.

    Where tables inside the one in which it stands have it, those are meant.
    """
    found = list[str]()

    def look(one: type[pydantic.BaseModel], title: str, depth: int, repeated: bool) -> None:
        for name, field in one.model_fields.items():
            written, kind = field.alias or name, get_origin(field.annotation)
            if title and written == key:
                found.append(f"[[{title}]]" if repeated else f"[{title}]")
            below = f"{title}.{written}".lstrip(".") + (".NAME" if kind is dict else "")
            for table in _models(field.annotation) if depth < _DEEPEST else ():
                look(table, below, depth + 1, kind in (list, tuple))

    look(model, "", 0, False)
    inside = [title for title in found if table and title.lstrip("[").startswith(f"{table}.")]
    *others, last = tables = list(dict.fromkeys(inside or found)) or [""]
    if len(tables) > _MOST_TABLES:
        return f"it belongs to a table such as {tables[0]}."
    return f"it belongs to {', '.join(others)}{' or ' if others else ''}{last}." if found else ""


def _allowed(error: Any) -> str:
    """Return the problem of one of pydantic's errors and what is allowed, without the closing full stop."""
    kind = error["type"]
    message = error["msg"].removeprefix("Value error, ").removeprefix("Input should be ").removesuffix(".")
    message = _WORDS.get(kind, message)
    return message if kind in ("value_error", "assertion_error") else f"it should be {message}"


def _sentence(error: Any, model: type[pydantic.BaseModel], source: str) -> str:
    """Return one of pydantic's errors as a sentence that names file, field, value and allowed values."""
    place, kind = error["loc"], error["type"]
    tables = [str(p) for p in place[:-1] if not isinstance(p, int)]
    field = "".join(f"[{i}]" if isinstance(i, int) else f".{i}" for i in place).lstrip(".")
    if len(place) > 1 and all(isinstance(p, str) for p in place):
        field = f"[{'.'.join(tables)}] {place[-1]}"
    field = cut(field, 100)
    if kind == "missing":
        return f"{source}: {field} is missing."
    if kind == "extra_forbidden":
        key, keys = str(place[-1]), _keys(model, place[:-1])
        # A plural for a singular is a slip in this table, whatever other tables have.
        near = did_you_mean(key, [known for known in keys if known in (f"{key}s", key.removesuffix("s"))])
        near = near or _tables_with(model, key, ".".join(tables)) or did_you_mean(key, keys)
        near = near or "check its spelling or remove it."
        return f"{source}: {field} is not a known key; {near}"
    if counted := _COUNT.fullmatch(error["msg"]):
        entries = "entry" if counted[1].endswith(" 1") else "entries"
        return f"{source}: {field} must have {counted[1]} {entries}, not {counted[2]}."
    message = _allowed(error)
    message += "" if message.endswith("?") else "."
    if not field:
        return f"{source}: {message}"
    if isinstance(error["input"], Mapping):  # a table: its contents can be read in the file
        return f"{source}: [{cut('.'.join(map(str, place)), 100)}]: {message}"
    return f"{source}: {field} = {shown(error['input'])}: {message}"


def _input_error(problems: pydantic.ValidationError, model: type[pydantic.BaseModel], source: str) -> InputError:
    found = problems.errors(include_url=False, include_context=False)
    # Pydantic does not count invalid entries; "too few entries" because of them would only repeat their errors.
    entries = {e["loc"][:-1] for e in found if e["loc"]} | {e["loc"][:-2] for e in found if len(e["loc"]) > 1}
    found = [e for e in found if not (e["type"] == "too_short" and e["loc"] in entries)]
    said = [_sentence(e, model, source) for e in found[:5]]
    if len(found) > 5:
        said.append(f"{source}: {len(found) - 5} more problems.")
    return InputError("\n".join(said))


def validated(model: type[Model], data: dict[str, Any], source: str) -> Model:
    """Return the data of a file, validated by `model`; every quantity needs its unit.

    Raises
    ------
    InputError
        One sentence per problem, each naming `source`.
    """
    try:
        return model.model_validate(data, context={"file": source})
    except pydantic.ValidationError as problems:
        raise _input_error(problems, model, source) from None
