"""Contacts side by side: several go through the processor's vector registers together.

A loop over the lanes of a group becomes vector instructions where it has neither branches nor calls: so the arrays of
one record are at fixed distances, choices are conditional expressions, and sine, cosine and logarithm are polynomials.
A group has as many lanes as there are contacts, so that independent vectors fill the latency of each other; a constant
number would have the loops unrolled before they are vectorised. Records of lanes are on the stack, because kernels do
not count references (`compiling`). See docs/development/speed.md.
"""

from __future__ import annotations

import math
from typing import Any, cast

import numpy as np
from numba import config, types
from numba.extending import intrinsic

from cycloid_fmu.contact.compiling import compiled

LANES = 32  # of one group at most

Lanes = np.record
_ROUND = 6755399441055744.0  # 1.5·2⁵²: added to a small number, it leaves no bits for a fraction
_HALF_PI_HIGH, _HALF_PI_LOW = 1.57079632673412561417, 6.07710050650619224932e-11  # the first has 33 bits
_LN2 = 6.93147180559945286227e-01


def lanes_of(*names: str, numbers: tuple[str, ...] = ()) -> np.dtype[np.void]:
    """Return a record of `LANES` numbers for each name, and of one integer for each of `numbers`."""
    of_lanes = [(name, np.float64, (LANES,)) for name in names]
    return np.dtype((np.record, [*of_lanes, *((name, np.int64) for name in numbers)]))


def record_of(*names: str) -> np.dtype[np.void]:
    """Return a record of one number for each name, whose fields kernels and Python take as attributes."""
    return np.dtype((np.record, [(name, np.float64) for name in names]))


@compiled(inline=True)
def vectors(filled: int) -> int:
    """Lanes of a group that are computed: whole vectors of four, at least one, so that no loop has a remainder."""
    return max((filled + 3) & -4, 4)


def on_stack(dtype: np.dtype[np.void]) -> Lanes:
    """Return a record of lanes, in kernels on the stack of the function that calls this, zero where it begins."""
    return cast(np.record, np.zeros(1, dtype)[0])


@intrinsic  # type: ignore[misc, untyped-decorator]
def _on_stack(typing: Any, dtype: Any) -> Any:
    def lower(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        # The way of numba itself stores zeros element by element, which takes LLVM 3 s.
        size = signature.return_type.size
        with builder.goto_entry_block():
            memory = builder.alloca(context.get_data_type(signature.return_type))
            memory.align = 64
            byte, length = context.get_value_type(types.uint8), context.get_constant(types.intp, size)
            fill = builder.module.declare_intrinsic("llvm.memset", (byte.as_pointer(), length.type))
            start = builder.bitcast(memory, byte.as_pointer())
            builder.call(fill, [start, byte(0), length, context.get_constant(types.boolean, False)])
        return memory

    return dtype.dtype(dtype), lower


if not config.DISABLE_JIT:
    on_stack = _on_stack


@compiled(inline=True)
def sine_cosine(angle: float) -> tuple[float, float]:
    """Sine and cosine, to 2e-16 for angles up to 1e5 rad (polynomials of fdlibm, within a quarter turn)."""
    quarters = (angle * (2.0 / math.pi) + _ROUND) - _ROUND
    r = (angle - quarters * _HALF_PI_HIGH) - quarters * _HALF_PI_LOW
    z = r * r
    s = r + r * z * (
        -1.66666666666666324348e-01
        + z
        * (
            8.33333333332248946124e-03
            + z
            * (
                -1.98412698298579493134e-04
                + z * (2.75573137070700676789e-06 + z * (-2.50507602534068634195e-08 + z * 1.58969099521155010221e-10))
            )
        )
    )
    c = (
        1.0
        - 0.5 * z
        + z
        * z
        * (
            4.16666666666666019037e-02
            + z
            * (
                -1.38888888888741095749e-03
                + z
                * (
                    2.48015872894767294178e-05
                    + z
                    * (-2.75573143513906633035e-07 + z * (2.08757232129817482790e-09 + z * -1.13596475577881948265e-11))
                )
            )
        )
    )
    half = 0.5 * quarters
    odd = half != (half + _ROUND) - _ROUND
    sine, cosine = (c, -s) if odd else (s, c)
    half = 0.25 * (quarters - (1.0 if odd else 0.0))
    sign = -1.0 if half != (half + _ROUND) - _ROUND else 1.0
    return sign * sine, sign * cosine


@compiled(inline=True)
def logarithm(value: float) -> float:
    """Natural logarithm of a positive number, to 2e-16 of 1 or of itself (polynomial of fdlibm)."""
    bits = np.float64(value).view(np.int64)
    exponent = (bits - 0x3FE6A09E667F3BCD) >> 52  # so that the mantissa is from √½ to √2
    f = np.int64(bits - (exponent << 52)).view(np.float64) - 1.0
    s = f / (2.0 + f)
    z = s * s
    rest = z * (
        6.666666666666735130e-01
        + z
        * (
            3.999999999940941908e-01
            + z
            * (
                2.857142874366239149e-01
                + z
                * (
                    2.222219843214978396e-01
                    + z * (1.818357216161805012e-01 + z * (1.531383769920937332e-01 + z * 1.479819860511658591e-01))
                )
            )
        )
    )
    return float(exponent * _LN2 + (f - s * (f - rest)))
