"""The contacts of an exact FMU: the contact problem as a function that the model in time calls from C.

`fmu/clockwork/exact_contacts.c` puts `struct contacts` around it. A solution begins at the last one, whose rows and
positions are the blocks of memory that the C code saves and restores.
"""

from __future__ import annotations

import ctypes
import functools
import math
from typing import Any, NamedTuple

import numpy as np
from numba import carray, cfunc, typeof, types
from numba.experimental import structref
from numba.extending import intrinsic
from numpy.typing import NDArray

from cycloid_fmu import contact
from cycloid_fmu.contact import Array, Problem, Rows, compiled
from cycloid_fmu.contact.compiling import SOURCES
from cycloid_fmu.contact.load_sharing import load_sharing
from cycloid_fmu.contact.transmission import UNBALANCED, rigid_problem
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.fmu.constants import (
    LARGEST_LOAD,
    SOLVE_HOLD,
    SOLVE_LOAD,
    SOLVE_PLAY,
    SOLVE_PRESS,
    SOLVE_TOUCH,
    SOLVE_TURN,
    UNRATED_LOAD,
)
from cycloid_fmu.supports import energy
from cycloid_fmu.supports.balance import Load
from cycloid_fmu.supports.bearing import CENTRING
from cycloid_fmu.supports.joints import work_of
from cycloid_fmu.supports.transmission import assembly_of, play_loads, problem_of

_Memory = tuple[NDArray[Any], ...]
_SOLVED, _UNBALANCED, _UNSOLVED = range(3)  # `enum contacts_status` in C
_STIFFEST = 1e12  # N·m/rad: in place of a flange without compliance; it turns by some 1e-5″
_PRESSED_CENTRING = 1e4  # N/m: with two prescribed flanges the discs cross their clearances at every reversal
_BALANCED = 1e-6  # N: smaller residuals are within rounding
_NEAR = 1.0  # rad: a solution farther away is no useful start
_CRANK_STEP = 1e-5  # rad: crank step for the derivative of an end of the play
_FREE_ENERGY = 1e-7  # J: largest stored energy of gears that are free in the plays around them

# Indices of `numbers` of a mesh: transmission error of the last solution, whether rows are not solved yet.
_X, _COLD, _PLAY_COLD = range(3)
# Those of a drive on its bearings: crank angles of its three solutions, and the tangent in use.
_LOW, _HIGH, _SIDE, _SHARE_OF, _TANGENT = 1, 2, 3, 4, 5


class _Mesh(NamedTuple):
    """Gear and pins on rigid bearings, and the memory of their solver."""

    drive: Problem
    rows: Rows
    play_rows: Rows
    numbers: Array
    pin_force: Array
    pin_pressure: Array


class _OnBearings(NamedTuple):
    """A drive on its bearings, and the memory of its solver: of the last solution, and of those at both play's ends."""

    stands: tuple[Any, ...]
    rows: tuple[Rows, ...]
    results: tuple[Array, ...]
    numbers: Array
    pin_force: Array
    pin_pressure: Array


@structref.register
class _BoxType(types.StructRef):  # type: ignore[misc]
    def preprocess_fields(self, fields: Any) -> Any:
        return tuple((name, types.unliteral(kind)) for name, kind in fields)


class _Box(structref.StructRefProxy):  # type: ignore[misc]
    """Contacts as one address, which C passes on to the callback."""


structref.define_proxy(_Box, _BoxType, ["contacts"])


@intrinsic  # type: ignore[untyped-decorator]
def _address(context: Any, box: Any) -> Any:
    """Address of a box: the one member of its value points to what it holds."""

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        pointer = builder.extract_value(arguments[0], 0)
        return builder.ptrtoint(pointer, context.get_value_type(types.intp))

    return types.intp(box), code


@intrinsic(prefer_literal=True)  # type: ignore[untyped-decorator]
def _box_at(context: Any, address: Any, kind: Any) -> Any:
    """The box at an address, of one of the types `_KINDS`."""
    box = _KINDS[kind.literal_value]

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        empty = context.get_constant_undef(box)
        value = builder.insert_value(empty, builder.inttoptr(arguments[0], empty.type.elements[0]), 0)
        context.nrt.incref(builder, box, value)
        return value

    return box(types.intp, kind), code


@compiled
def _boxed(contacts: Any) -> _Box:
    return _Box(contacts)


@compiled
def _address_of(box: Any) -> int:
    return int(_address(box))


# Long as each operation is a few lines.
@compiled
def _solve_mesh(mesh: _Mesh, operation: int, crank_angle: float, a: float, b: float, result: Array) -> int:
    """Solve gear and pins.

    Parameters
    ----------
    operation, crank_angle
        One of the `SOLVE_` constants, and the crank angle, rad.
    a, b
        touch: an end of the play (rad) and its side (±1); load: the torque, N·m; hold and press: a transmission error
        (rad) and a compliance in series (rad/(N·m)); play, and turn and share, at the last solution: none.
    result
        play: both ends, rad. touch: dφ_b/dθ. load, hold and press: transmission error (rad), stiffness (N·m/rad),
        torque (N·m); and for press energy (J) and its derivatives by θ and φ_b (N·m). turn: the crank's torque (N·m)
        and dφ_b/dθ. share: pins in contact, and the largest pressure (Pa).
    """
    drive, rows, numbers = mesh.drive, mesh.rows, mesh.numbers
    x, cold = numbers[_X], numbers[_COLD] != 0.0
    if operation == SOLVE_LOAD:
        numbers[_COLD] = 0.0
        x, stiffness = contact.equilibrium(drive, crank_angle, a, x, rows, cold)
        result[0], result[1], result[2] = x, stiffness, a
        falling = a != 0.0 and not stiffness > 0.0  # as with worn flanks, or if nothing can balance the torque
        if not math.isfinite(x) or (falling and not abs(contact.carried(rows) - a) <= UNBALANCED * abs(a)):
            numbers[_COLD] = 1.0
            return _UNBALANCED
        numbers[_X] = x
    elif operation == SOLVE_TURN:
        result[0], result[1] = contact.crank_side(drive, crank_angle, x, rows)
    elif operation == SOLVE_PRESS:
        numbers[_COLD] = 0.0
        x, stiffness, stored, by_angle, by_rotation = contact.press(drive, crank_angle, a, b, x, rows, cold)
        result[0], result[1], result[2] = x, stiffness, by_rotation
        result[3], result[4], result[5] = stored, by_angle, by_rotation
        if not math.isfinite(by_rotation):
            numbers[_COLD] = 1.0
            return _UNSOLVED
        numbers[_X] = x
    elif operation == SOLVE_HOLD:
        numbers[_COLD] = 0.0
        x, stiffness = contact.behind_compliance(drive, crank_angle, a, b, x, rows, cold)
        result[0], result[1], result[2] = x, stiffness, contact.carried(rows)
        numbers[_X] = x
    elif operation == SOLVE_PLAY:
        low, high, interference = contact.play(drive, crank_angle, x, mesh.play_rows, numbers[_PLAY_COLD] != 0.0)
        numbers[_PLAY_COLD] = 0.0
        if interference > 0.0:
            numbers[_PLAY_COLD] = 1.0
            low, _ = contact.equilibrium(drive, crank_angle, 0.0, x, mesh.play_rows, True)
            high = low
        result[0], result[1] = low, high
        return _SOLVED if math.isfinite(low) else _UNSOLVED
    elif operation == SOLVE_TOUCH:
        contact.place_contacts(drive, crank_angle, a, mesh.play_rows, numbers[_PLAY_COLD] != 0.0, math.inf, math.inf)
        result[0] = contact.touch_rate(drive, crank_angle, a, mesh.play_rows, b)
    else:
        count, result[1] = load_sharing(drive, rows, mesh.pin_force, mesh.pin_pressure)
        result[0] = count
    return _SOLVED


@compiled
def _stand(floating: _OnBearings, i: int, crank_angle: float, load: Load) -> bool:
    """Solve one of the positions; return whether there is a solution."""
    numbers = floating.numbers
    cold = not abs(crank_angle - numbers[i]) < _NEAR
    numbers[i] = crank_angle
    if energy.stand(floating.stands[i], crank_angle, load, floating.rows[i], cold, floating.results[i]) == 0:
        numbers[i] = math.nan
    return bool(numbers[i] == crank_angle)


@compiled
def _end(floating: _OnBearings, crank_angle: float, side: float) -> tuple[float, float]:
    """End of the play on a side (±1), rad, NaN without a solution, and the stiffness there, N·m/rad."""
    i = _HIGH if side > 0.0 else _LOW
    torque = side * floating.numbers[_TANGENT]
    if floating.numbers[i] != crank_angle and not _stand(floating, i, crank_angle, Load(torque, 0.0, 0.0, CENTRING)):
        return math.nan, math.nan
    results = floating.results[i]
    return results[energy.X] - torque / results[energy.STIFFNESS], results[energy.STIFFNESS]


@compiled
def _ends(floating: _OnBearings, crank_angle: float) -> tuple[float, float]:
    """Both ends of the play, rad; the middle twice where there is none."""
    low, high = _end(floating, crank_angle, -1.0)[0], _end(floating, crank_angle, 1.0)[0]
    middle = 0.5 * (low + high)
    return (low, high) if low < high else (middle, middle)


@compiled
def _touch_rates(floating: _OnBearings, crank_angle: float, side: float) -> tuple[float, float]:
    """dφ_b/dθ at the end of the play on a side, and where the tangent there begins, to some 1e-6.

    Without play the two ends cross: tangents then begin at their own ends, but the play's end is the middle.
    """
    i = 1 if side > 0.0 else 0
    before, began = _ends(floating, crank_angle - _CRANK_STEP)[i], _end(floating, crank_angle - _CRANK_STEP, side)[0]
    after, begins = _ends(floating, crank_angle + _CRANK_STEP)[i], _end(floating, crank_angle + _CRANK_STEP, side)[0]
    ideal, wide = 1.0 / floating.stands[0].drive.teeth, 2.0 * _CRANK_STEP
    return float((after - before) / wide - ideal), float((begins - began) / wide - ideal)


@compiled
def _tangent(floating: _OnBearings, crank_angle: float, torque: float, side: float, result: Array) -> int:
    low, high = _ends(floating, crank_angle)
    _, stiffness = _end(floating, crank_angle, side)
    floating.numbers[_SIDE], floating.numbers[_SHARE_OF] = side, abs(torque) / floating.numbers[_TANGENT]
    result[0], result[1], result[2] = (high if side > 0.0 else low) + torque / stiffness, stiffness, torque
    return _SOLVED if math.isfinite(result[0]) else _UNBALANCED


@compiled
def _solve_pressed(
    floating: _OnBearings, crank_angle: float, flange: float, series: float, centring: float, result: Array
) -> int:
    floating.numbers[_SIDE], floating.numbers[_SHARE_OF] = 0.0, 1.0
    spring = min(1.0 / series, _STIFFEST) if series > 0.0 else _STIFFEST
    if not _stand(floating, 0, crank_angle, Load(0.0, spring, flange, centring)):
        return _UNSOLVED
    results = floating.results[0]
    result[0], result[1], result[2] = results[energy.X], results[energy.STIFFNESS], results[energy.TORQUE]
    return _SOLVED


@compiled
def _share_load(floating: _OnBearings, crank_angle: float, result: Array) -> None:
    side, share = floating.numbers[_SIDE], floating.numbers[_SHARE_OF]
    i = 0
    if side != 0.0:
        i = _HIGH if side > 0.0 else _LOW
        _end(floating, crank_angle, side)
    count, pressure = load_sharing(
        floating.stands[i].drive, floating.rows[i], floating.pin_force, floating.pin_pressure
    )
    # Along the tangent, forces are proportional to the torque and pressures to its square root.
    for disc in range(floating.pin_force.shape[0]):
        for pin in range(floating.pin_force.shape[1]):
            floating.pin_force[disc, pin] *= share
            floating.pin_pressure[disc, pin] *= math.sqrt(share)
    result[0], result[1] = count, pressure * math.sqrt(share)


# Long as each operation is a few lines.
@compiled
def _solve_on_bearings(
    floating: _OnBearings, operation: int, crank_angle: float, a: float, b: float, result: Array
) -> int:
    """Solve a drive on its bearings; parameters and results are those of `_solve_mesh`.

    Below the share `PLAY_LOAD` of the rated torque, the output follows the tangent at that share, so that the play
    remains at zero torque (`supports.transmission.play_loads`). Pressing solves every torque; inside the play, torques
    are smaller than that.
    """
    numbers = floating.numbers
    least = numbers[_TANGENT]
    if operation == SOLVE_LOAD:
        numbers[_SIDE], numbers[_SHARE_OF] = 0.0, 1.0
        if abs(a) < least:
            return _tangent(floating, crank_angle, a, math.copysign(1.0, a), result)
        if not _stand(floating, 0, crank_angle, Load(a, 0.0, 0.0, CENTRING)):
            return _UNBALANCED
        result[0], result[1], result[2] = floating.results[0][energy.X], floating.results[0][energy.STIFFNESS], a
    elif operation == SOLVE_TURN:
        side, share = numbers[_SIDE], numbers[_SHARE_OF]
        results = (
            floating.results[0] if side == 0.0 else (floating.results[_HIGH] if side > 0.0 else floating.results[_LOW])
        )
        rate, torque = results[energy.RATE], share * results[energy.TORQUE]
        if side == 0.0:
            result[0], result[1] = results[energy.CRANK_TORQUE], rate
        else:
            end, own = _touch_rates(floating, crank_angle, side)
            bent = share * (rate - own)
            result[0], result[1] = -torque * (end + 0.5 * bent), end + bent
    elif operation == SOLVE_PRESS:
        status = _solve_pressed(floating, crank_angle, a, b, _PRESSED_CENTRING, result)
        results = floating.results[0]
        result[2], result[3] = results[energy.BY_FLANGE], results[energy.ENERGY]
        result[4], result[5] = results[energy.BY_ANGLE], results[energy.BY_FLANGE]
        return status
    elif operation == SOLVE_HOLD:
        low, high = _ends(floating, crank_angle)
        if not math.isfinite(low):
            return _UNBALANCED
        side = 1.0 if a > 0.5 * (low + high) else -1.0
        if low < high and low <= a <= high:
            numbers[_SIDE], numbers[_SHARE_OF] = side, 0.0
            result[0], result[1], result[2] = a, 0.0, 0.0
            return _SOLVED
        torque = (a - (high if side > 0.0 else low)) / (1.0 / _end(floating, crank_angle, side)[1] + b)
        if abs(torque) < least:
            return _tangent(floating, crank_angle, torque, side, result)
        return _solve_pressed(floating, crank_angle, a, b, CENTRING, result)
    elif operation == SOLVE_PLAY:
        result[0], result[1] = _ends(floating, crank_angle)
        return _SOLVED if math.isfinite(result[0]) else _UNBALANCED
    elif operation == SOLVE_TOUCH:
        result[0] = _touch_rates(floating, crank_angle, b)[0]
    else:
        _share_load(floating, crank_angle, result)
    return _SOLVED


_SIGNATURE = types.int64(
    types.intp, types.int64, types.float64, types.float64, types.float64, types.CPointer(types.float64)
)
_KINDS: dict[str, Any] = {}  # types of boxes by their names


@functools.cache
def _callback(box: Any, on_bearings: bool) -> Any:
    """Return the C function of a type of box; what numba compiles is kept on disk until the kernels' sources change."""
    # numba distinguishes what it keeps by the values that a function encloses, which must be the same in each process.
    kind, sources = str(box), SOURCES
    _KINDS[kind] = box

    def solve_mesh(address: int, operation: int, crank_angle: float, a: float, b: float, result: Any) -> int:
        sources  # noqa: B018
        return _solve_mesh(_box_at(address, kind).contacts, operation, crank_angle, a, b, carray(result, (6,)))

    def solve_on_bearings(address: int, operation: int, crank_angle: float, a: float, b: float, result: Any) -> int:
        sources  # noqa: B018
        return _solve_on_bearings(_box_at(address, kind).contacts, operation, crank_angle, a, b, carray(result, (6,)))

    function = solve_on_bearings if on_bearings else solve_mesh
    return cfunc(_SIGNATURE, cache=True, error_model="numpy")(function)


class ExactContacts(NamedTuple):
    """Contacts for the model in time.

    Attributes
    ----------
    callback, box
        The C function that solves them, and its first argument, which must stay alive.
    loaded, play
        Arrays that hold the last solution under load, and that of the play.
    shared
        Arrays of the forces (N) and largest pressures (Pa) of each pin, shape (discs, pins), written by `share`.
    tangent
        Torque below which the play's solution takes part in that under load, N·m.
    stiffness
        At the largest torque, N·m/rad.
    free_energy
        Stored energy up to which gears are free in the plays around them, J.
    """

    callback: Any
    box: Any
    loaded: _Memory
    play: _Memory
    shared: tuple[Array, Array]
    tangent: float
    stiffness: float
    free_energy: float

    @property
    def address(self) -> int:
        """Address of the box."""
        return int(_address_of(self.box))


def exact_contacts(drive: DriveValue) -> ExactContacts:
    """Return the contacts of a drive, without its first stage.

    Raises
    ------
    edge.InputError
        If a pair on bearings has no rated torque.
    """
    pair = drive.pair
    shared = np.zeros((pair.discs, pair.pins)), np.zeros((pair.discs, pair.pins))
    floats = pair.supports is not None
    solved, loaded, play, tangent = (_of_bearings if floats else _of_mesh)(drive, shared)
    box = _boxed(solved)
    callback = _callback(typeof(box), floats)
    contacts = ExactContacts(callback, box, (*loaded, *shared), play, shared, tangent, 0.0, _FREE_ENERGY)
    initial = [array.copy() for array in loaded]
    largest, result = LARGEST_LOAD * (pair.rated_torque or UNRATED_LOAD), (ctypes.c_double * 6)()
    contacts.callback.ctypes(contacts.address, SOLVE_LOAD, 0.0, largest, 0.0, result)
    for array, value in zip(loaded, initial, strict=True):
        array[...] = value
    return contacts._replace(stiffness=result[1])


def _of_mesh(drive: DriveValue, shared: tuple[Array, Array]) -> tuple[Any, _Memory, _Memory, float]:
    problem = rigid_problem(drive, drive.slices)
    rows, play_rows, numbers = contact.contact_rows(problem), contact.contact_rows(problem), np.array([0.0, 1.0, 1.0])
    return _Mesh(problem, rows, play_rows, numbers, *shared), (rows, numbers), (play_rows,), 0.0


def _of_bearings(drive: DriveValue, shared: tuple[Array, Array]) -> tuple[Any, _Memory, _Memory, float]:
    pair = drive.pair
    tangent = play_loads(pair)[1]
    assembly = assembly_of(drive)
    assembly = assembly._replace(balanced=max(assembly.balanced, _BALANCED))
    stands, memory = [], []
    for _ in range(3):
        shift_x, shift_y, turn = (np.zeros(pair.discs) for _ in range(3))
        problem = problem_of(drive, drive.slices)._replace(shift_x=shift_x, shift_y=shift_y, turn=turn)
        work, results, rows = work_of(assembly), np.zeros(energy.FOUND), contact.contact_rows(problem)
        stands.append((energy.held(problem, assembly, work), rows, results))
        of_ports = () if work.ports is None else (work.ports.ports, work.ports.reach)
        memory.append((rows, results, work.coordinates, work.pose, work.moved, *of_ports))
    numbers = np.array([math.nan, math.nan, math.nan, 0.0, 1.0, tangent])
    held, rows_of, results_of = (tuple(parts) for parts in zip(*stands, strict=True))
    floating = _OnBearings(held, rows_of, results_of, numbers, *shared)
    return floating, (*memory[0], numbers), (*memory[_LOW], *memory[_HIGH]), tangent
