"""The table of the largest orders of a run."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from fitting.figures.figure import Figure, in_field_units
from fitting.transmission_error.orders import RunOrders

_SHOWN = 8  # orders of a run in a table
ORDERS_HEAD = ("order", "amplitude", "± 95 %", "unit", "source")


def order_rows(runs: Sequence[RunOrders]) -> list[list[str]]:
    """Return the rows of a table, for people, of the largest orders of each direction's run with the largest."""
    rows = []
    for direction in (1, -1):
        of_direction = [run for run in runs if run.direction == direction and run.orders]
        if not of_direction:
            continue
        largest = max(of_direction, key=lambda run: run.orders[0].amplitude)
        rows.append([Path(largest.run).name, "", "", "", ""])
        for order in largest.orders[:_SHOWN]:
            known = Figure(order.amplitude, order.uncertainty, "rad", "", None, "rad", largest.turns, "turns")
            name = f"{order.order:.0f}" if order.whole else f"{order.order:.4g}"
            rows.append([f"  {name}", *in_field_units(known), order.source])
    return rows
