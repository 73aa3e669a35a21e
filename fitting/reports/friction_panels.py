"""Panels of a friction fit: the torque over the speed, and what the fit leaves."""

from __future__ import annotations

import numpy as np

from cycloid_fmu import edge
from fitting.figures.friction import FrictionFit
from fitting.reports.panels import Panel, Trace


def friction_panels(friction_fit: FrictionFit) -> list[Panel]:
    """Return the panels of torque and residual over the speed of the output.

    Raises
    ------
    edge.InputError
        If no friction over speed was fitted.
    """
    stretches, load = friction_fit.stretches, friction_fit.loads
    if not stretches.speed.size:
        raise edge.InputError("There is no plot of starting torques alone; metrics --plot has one.")
    used = np.isfinite(friction_fit.fitted)
    speed, torque = stretches.speed[used], (stretches.torque - sum(friction_fit.removed.values()))[used]
    block, recording, fitted = stretches.block[used], stretches.recording[used], friction_fit.fitted[used]
    count = np.bincount(block)
    at = count > 0
    middle, mean, rest = (np.bincount(block, v)[at] / count[at] for v in (speed, torque, torque - fitted))
    traces = [Trace("means over stretches of time", speed, torque, "points", -1)]
    residuals = [Trace("", speed, torque - fitted, "points", -1)]
    for number, k in enumerate(np.unique(recording)):
        name = list(friction_fit.data)[k]
        label = f"fit, {load[name]:.3g} N·m" if load else "fit"
        for sign in (-1.0, 1.0):
            of = np.flatnonzero((recording == k) & (np.sign(speed) == sign))
            of = of[np.argsort(speed[of])]
            if of.size:
                once = label if load or number == 0 else ""
                traces.append(Trace(once, speed[of], fitted[of], "thick", number + 1 if load else 1))
                label = ""
    traces.append(Trace("blocks", middle, mean, "dots", 0))
    residuals.append(Trace("blocks", middle, rest, "dots", 0))
    residuals.append(Trace("", np.array([speed.min(), speed.max()]), np.zeros(2), "dashed", -1))
    low, high = friction_fit.speeds
    seen = (
        f"Fitted from {low:.4g} to {high:.4g} rad/s, the torque that drives, without inertia and drift. The scatter "
        "of the blocks gives the uncertainty."
    )
    axis = "speed of the output [rad/s]"
    return [
        Panel("Friction over speed", axis, "torque at the output [N·m]", tuple(traces), seen),
        Panel("Residual", axis, "torque less fit [N·m]", tuple(residuals), "What the fit leaves."),
    ]
