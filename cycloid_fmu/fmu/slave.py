"""The FMI 2.0 Co-Simulation slave, on pythonfmu; names, units and meaning of its variables: design.md section 7."""

from __future__ import annotations

import ctypes
import functools
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar, cast
from xml.etree.ElementTree import Element, SubElement

import numpy as np
from pythonfmu import DefaultExperiment, Fmi2Slave
from pythonfmu.enums import Fmi2Causality, Fmi2Initial, Fmi2Variability
from pythonfmu.variables import Integer, Real

from cycloid_fmu import __version__
from cycloid_fmu.fmu.model import DriveModel
from cycloid_fmu.fmu.reducer_model import FirstStage, ReducerModel
from cycloid_fmu.pair import LARGEST_DEVIATION, LARGEST_MISALIGNMENT, Pair
from cycloid_fmu.surface import DESCRIPTIONS, PATTERNS, ErrorSurface, Life, unit_of

NUMBERS, ARRAYS = "pair.json", "surface.npz"

# unit: exponents of SI base units, then display units with their factor
_UNITS: dict[str, tuple[dict[str, int], dict[str, float]]] = {
    "rad": ({"rad": 1}, {"deg": 180 / np.pi, "arcmin": 10800 / np.pi, "arcsec": 648000 / np.pi}),
    "rad/s": ({"rad": 1, "s": -1}, {"rev/min": 30 / np.pi, "deg/s": 180 / np.pi}),
    "N.m": ({"kg": 1, "m": 2, "s": -2}, {}),
    "N.m/rad": ({"kg": 1, "m": 2, "s": -2, "rad": -1}, {"N.m/arcmin": np.pi / 10800}),
    "rad/(N.m)": ({"kg": -1, "m": -2, "s": 2, "rad": 1}, {"arcsec/(N.m)": 648000 / np.pi}),
    "Pa": ({"kg": 1, "m": -1, "s": -2}, {"MPa": 1e-6}),
    "m": ({"m": 1}, {"um": 1e6, "mm": 1e3}),
}


_Method = TypeVar("_Method", bound=Callable[..., Any])


def _kept_alive(method: _Method) -> _Method:
    """Keep the slave alive after an exception: pythonfmu 0.7.0 then gives its references back twice."""

    @functools.wraps(method)
    def guarded(self: DriveSlave, *arguments: Any) -> Any:
        try:
            return method(self, *arguments)
        except Exception:
            for kept in (self, type(self), self.log_queue):
                ctypes.pythonapi.Py_IncRef(ctypes.py_object(kept))
            raise

    return cast(_Method, guarded)


class DriveSlave(Fmi2Slave):  # type: ignore[misc]
    """Cycloid-pin gear drive with its manufacturing and assembly errors."""

    author = "cycloid-fmu"
    license = "MIT"
    description = "Cycloid-pin gear drive: transmission error, backlash and load sharing from its error surface"

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.version = __version__
        self.default_experiment = DefaultExperiment(start_time=0.0, stop_time=1.0, step_size=1e-3)
        resources = Path(self.resources)
        numbers = json.loads((resources / NUMBERS).read_text(encoding="utf-8"))
        if numbers["package_version"] != __version__:
            raise RuntimeError(
                f"this FMU was built with cycloid-fmu {numbers['package_version']}, installed is {__version__}; build "
                "the FMU again or install that version"
            )
        with np.load(resources / ARRAYS) as arrays:
            values: dict[str, Any] = {n: arrays[n] if arrays[n].shape else float(arrays[n]) for n in arrays.files}
            states = {n.removeprefix("life_"): values.pop(n) for n in arrays.files if n.startswith("life_")}
            surface = ErrorSurface(**values, life=Life(**states) if states else None)
        pair, stage = Pair.from_numbers(numbers["pair"]), numbers.get("first_stage")
        model = DriveModel(pair, surface) if stage is None else ReducerModel(pair, surface, FirstStage(**stage))
        self.model, driven = model, "crank" if stage is None else "sun"
        self._attributes: dict[str, dict[str, str]] = {}
        self._depends: dict[str, tuple[str, ...]] = {}

        inputs = ("flange_a.phi", "flange_a.w", "flange_b.tau")
        self._add("flange_a.phi", "rad", f"{driven} angle, counter-clockwise", "crank_angle", display="deg")
        self._add("flange_a.w", "rad/s", f"{driven} speed", "crank_speed", display="rev/min")
        self._add("flange_b.tau", "N.m", "torque of the environment on the output, counter-clockwise", "torque")
        angle_and_torque = (inputs[0], inputs[2])
        for name, unit, text, attribute, display, least, depends in (
            ("flange_b.phi", "rad", "output angle", "output_angle", "deg", None, angle_and_torque),
            ("flange_b.w", "rad/s", "output speed at the present torque", "output_speed", "rev/min", None, inputs),
            ("flange_a.tau", "N.m", f"torque to give the {driven}", "crank_torque", None, None, angle_and_torque),
            ("transmission_error", "rad", f"output angle less {driven} angle/ratio", "transmission_error", "arcsec",
             None, angle_and_torque),
            ("backlash", "rad", f"free rotation of the output with the {driven} locked; 0 where there is none",
             "backlash", "arcsec", 0.0, inputs[:1]),
            ("torsional_stiffness", "N.m/rad", "torsional stiffness at the output", "torsional_stiffness",
             "N.m/arcmin", 0.0, angle_and_torque),
            ("max_contact_pressure", "Pa", "largest contact pressure", "max_contact_pressure", "MPa", 0.0,
             angle_and_torque),
        ):  # fmt: skip
            self._add(name, unit, text, attribute, display=display, least=least, depends=depends)
        count = Integer(
            "contact_count", causality=Fmi2Causality.output, variability=Fmi2Variability.discrete,
            description="pins that carry more than 1 % of the most loaded pin's force",
            getter=lambda: model.contact_count,
        )  # fmt: skip
        self.register_variable(count, nested=False)
        self._attributes["contact_count"] = {"min": "0", "max": str(model.pair.pair.pins * model.pair.pair.discs)}
        self._depends["contact_count"] = angle_and_torque

        for name in model.errors:
            unit = unit_of(name)
            limit = LARGEST_MISALIGNMENT if unit == "rad" else LARGEST_DEVIATION
            pattern = next((p for p in PATTERNS if name.startswith(p + "_")), name)
            text = DESCRIPTIONS[pattern]
            if pattern != name:
                order, part = name.removeprefix(pattern + "_").split("_")
                text += f": {'cosine' if part == 'cos' else 'sine'} part of order {order}"
            self._add(name, unit, text, None, display="arcsec" if unit == "rad" else "um", least=-limit, most=limit)
        self._add("friction_torque", "N.m", "dry friction at the output", "friction_torque", least=0.0, parameter=True)
        self._add("series_compliance", "rad/(N.m)", "compliance of the rest of the chain", "series_compliance",
                  display="arcsec/(N.m)", least=0.0, parameter=True)  # fmt: skip
        if surface.life is not None:
            self._add("crank_turns_worn", None, "crank turns since new: how far the drive is worn", "crank_turns_worn",
                      least=0.0, most=float(surface.life.crank_turns[-1]), parameter=True)  # fmt: skip
        self._getters = [v.getter for v in self.vars.values()]
        self._setters = [v.setter for v in self.vars.values()]

    def _add(
        self,
        name: str,
        unit: str | None,
        text: str,
        attribute: str | None,
        *,
        display: str | None = None,
        least: float | None = None,
        most: float | None = None,
        depends: tuple[str, ...] | None = None,
        parameter: bool = False,
    ) -> None:
        """Register a real variable: an output where it depends on inputs, a parameter, else an input."""
        model = self.model
        setter: Callable[[float], None] | None
        if attribute is None:
            getter, setter = (lambda: model.errors[name]), (lambda v: model.set_error(name, v))
        else:
            getter, setter = (lambda: getattr(model, attribute)), (lambda v: setattr(model, attribute, v))
        variability, initial = Fmi2Variability.continuous, None
        if depends is not None:
            causality, setter = Fmi2Causality.output, None
            self._depends[name] = depends
        elif parameter or attribute is None:
            causality, variability, initial = Fmi2Causality.parameter, Fmi2Variability.tunable, Fmi2Initial.exact
        else:
            causality = Fmi2Causality.input
        variable = Real(
            name, causality=causality, variability=variability, initial=initial, description=text, getter=getter,
            setter=setter,
        )  # fmt: skip
        self.register_variable(variable, nested=False)
        attributes = {"unit": unit, "displayUnit": display, "min": least, "max": most}
        self._attributes[name] = {k: str(v) for k, v in attributes.items() if v is not None}

    @_kept_alive
    def exit_initialization_mode(self) -> None:
        """Settle at the initial inputs, without history."""
        self.model.forget_history()
        self.model.advance()

    @_kept_alive
    def do_step(self, current_time: float, step_size: float) -> bool:
        """Move to the inputs' present values; the drive is quasi-static, so the step's length does not matter."""
        self.model.advance()
        return True

    @_kept_alive
    def get_real(self, vrs: Sequence[int]) -> list[float]:
        """Return values by reference (pythonfmu's own checks types, which costs more than the physics)."""
        getters = self._getters
        return [getters[v]() for v in vrs]

    @_kept_alive
    def set_real(self, vrs: Sequence[int], values: Sequence[float]) -> None:
        """Set values by reference."""
        setters = self._setters
        for v, value in zip(vrs, values, strict=True):
            setters[v](value)

    @_kept_alive
    def _get_fmu_state(self) -> dict[str, Any]:
        return self.model.state()

    @_kept_alive
    def _set_fmu_state(self, state: dict[str, Any]) -> None:
        self.model.restore(state)

    def to_xml(self, model_options: dict[str, str] | None = None) -> Element:
        """Return the model description with what pythonfmu leaves out: units, limits, dependencies, unknowns."""
        root: Element = super().to_xml(model_options or {})
        units = Element("UnitDefinitions")
        for unit, (base, displays) in _UNITS.items():
            node = SubElement(units, "Unit", name=unit)
            SubElement(node, "BaseUnit", {k: str(v) for k, v in base.items()})
            for display, factor in displays.items():
                SubElement(node, "DisplayUnit", name=display, factor=repr(float(factor)))
        root.insert(1, units)
        index: dict[str, str] = {}
        for number, variable in enumerate(root.iter("ScalarVariable"), start=1):
            name = variable.get("name", "")
            index[name] = str(number)
            variable[0].attrib.update(self._attributes.get(name, {}))
        structure = root.find("ModelStructure")
        assert structure is not None
        structure.clear()
        errors = [n for n in (*self.model.errors, "series_compliance", "crank_turns_worn") if n in index]
        for section, parameters in (("Outputs", []), ("InitialUnknowns", errors)):
            node = SubElement(structure, section)
            for name in sorted(self._depends, key=lambda n: int(index[n])):
                known = sorted(int(index[n]) for n in (*self._depends[name], *parameters))
                SubElement(node, "Unknown", index=index[name], dependencies=" ".join(map(str, known)))
        return root
