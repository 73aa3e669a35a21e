"""Contact of gear and pins: gaps, Hertz force, equilibrium, play and sensitivities, compiled, on plain arrays.

The flank is the curve parallel, at the generating pin's radius r, to the path of the generating pin's centre in the
gear, T(α) = R e^{iα} - e e^{i z_p α}: so the gap of a pin is the signed distance of its axis from T, plus r, less the
pin's radius, and its foot on T and on the flank are the same α (docs/theory/contact.md; turned by -90° so that
tooth 0 begins at +x). A point is a complex number in the comments and a pair (x, y) in the code.

The unknown is x, the output's transmission error: gear angle -θ/z_c + x with the pin ring fixed, or ring
angle θ/z_p + x with the gear held. Torque is what the environment puts on the output; force times arm balances it.

Each module is one step, under the headings of that page: the problem (`problem`), where disc, pins and teeth are
(`pose`), a pin's foot on a flank (`foot`), its gap and moment arm (`gap`), all pins at once (`placement`) with
deviations of form (`deviations`), the Hertz force (`hertz`), what balances a torque (`equilibrium`) or none (`play`),
and what follows: `load_sharing`, `energy`, `sensitivity`. `local_frame` has the contact's gradients in the housing.
`sweeps` go through crank angles. The names and units of what is known of a contact are those of `rows`.

The angle θ of the formulas is `crank_angle`; where a disc's own crank is meant, its phase is added (`poses`).
"""

from cycloid_fmu.contact.compiling import Array, compiled
from cycloid_fmu.contact.energy import crank_side, elastic_energy, press
from cycloid_fmu.contact.equilibrium import behind_compliance, carried, equilibrium
from cycloid_fmu.contact.hertz import half_width, hertz
from cycloid_fmu.contact.load_sharing import ContactLines, load_sharing
from cycloid_fmu.contact.local_frame import LocalFrame, local_frame
from cycloid_fmu.contact.placement import place_contacts
from cycloid_fmu.contact.play import TOUCHING, play, touch_rate
from cycloid_fmu.contact.problem import Deviations, Drives, Problem, poses
from cycloid_fmu.contact.rows import ROW, Rows, contact_rows, disc_slice_pin, is_solved_at
from cycloid_fmu.contact.sensitivity import sensitivities
from cycloid_fmu.contact.sweeps import (
    LoadedSweep,
    sweep,
    sweep_contacts,
    sweep_crank_side,
    sweep_flank_sensitivities,
    sweep_play,
    sweep_sensitivities,
)

__all__ = [
    "ROW",
    "TOUCHING",
    "Array",
    "ContactLines",
    "Deviations",
    "Drives",
    "LoadedSweep",
    "LocalFrame",
    "Problem",
    "Rows",
    "behind_compliance",
    "carried",
    "compiled",
    "contact_rows",
    "crank_side",
    "disc_slice_pin",
    "elastic_energy",
    "equilibrium",
    "half_width",
    "hertz",
    "is_solved_at",
    "load_sharing",
    "local_frame",
    "place_contacts",
    "play",
    "poses",
    "press",
    "sensitivities",
    "sweep",
    "sweep_contacts",
    "sweep_crank_side",
    "sweep_flank_sensitivities",
    "sweep_play",
    "sweep_sensitivities",
    "touch_rate",
]
