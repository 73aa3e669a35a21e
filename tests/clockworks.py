"""Drives in time for the tests: variables as attributes, a step in one call."""

import math

from cycloid_fmu.fmu.clockwork import Clockwork, StepError
from cycloid_fmu.fmu.friction import FLANGES
from cycloid_fmu.fmu.variables import ABSOLUTE, ATTRIBUTES, LOSSLESS, Interface

NAMES = {attribute: name for names in (ATTRIBUTES, ABSOLUTE) for name, attribute in names.items()}
OWN = ("pair", "clockwork", "started")


class Drive:
    """A drive in time: `crank_angle` is `flange_a.phi` and so on; `advance` settles it first where it did not start."""

    def __init__(self, drive, interface):
        self.pair, self.clockwork, self.started = drive.pair, Clockwork(drive, interface), False

    def __getattr__(self, name):
        return self.clockwork.get(NAMES.get(name, name))

    def __setattr__(self, name, value):
        if name in OWN:
            object.__setattr__(self, name, value)
        else:
            self.clockwork.set(NAMES.get(name, name), value)

    @property
    def errors(self):
        return self.clockwork.errors

    set_error = __setattr__

    def set_friction(self, flange, **values):
        for name, value in values.items():
            output_coulomb = (flange, name) == (1, "coulomb")
            self.clockwork.set("friction_torque" if output_coulomb else f"{FLANGES[flange]}_friction.{name}", value)

    def set_loss(self, row, column, value):
        self.clockwork.set(f"loss_table[{row + 1},{column + 1}]", value)

    def forget_history(self):
        self.started = True
        self.clockwork.start()

    def advance(self, step=0.0):
        if not self.started:
            self.forget_history()
        refused = self.clockwork.advance(self.clockwork.time, step)
        if refused:
            raise StepError(refused)

    def pressed(self, crank_angle, output_angle):
        """Torques of a compliant drive without damping and friction at its flanges, at rest at these angles."""
        self.crank_angle, self.output_angle = crank_angle, output_angle
        return self.crank_torque, self.torque

    def state(self):
        return self.clockwork.state()

    def restore(self, state):
        self.started = True
        self.clockwork.restore(state)


def kinematic_drive(drive, losses=LOSSLESS):
    return Drive(drive, Interface(losses=losses, driven="crank" if drive.first_stage is None else "sun"))


def compliant_drive(drive, losses=LOSSLESS, output_inertia=0.0, crank_inertia=0.0):
    driven = "crank" if drive.first_stage is None else "sun"
    return Drive(drive, Interface("compliant", output_inertia, losses, driven, crank_inertia))


def torques_of_energy(model, crank, output):
    """Differences of a model's stored energy by both flanges' angles, N·m; the model is left at these angles."""

    def energy(crank, output):
        model.crank_angle, model.output_angle = crank, output
        return model.elastic_energy

    by_crank = (energy(crank + 1e-6, output) - energy(crank - 1e-6, output)) / 2e-6
    by_output = (energy(crank, output + 1e-8) - energy(crank, output - 1e-8)) / 2e-8
    model.crank_angle, model.output_angle = crank, output
    return by_crank, by_output


def check_restored(model, other, steps, torque):
    """A state restores exactly, also in another instance: kinematic drives under a torque of this amplitude, N·m."""

    def run(model, start):
        outputs = []
        for i in range(start, start + steps):
            model.crank_angle, model.torque, model.crank_speed = 0.03 * i, torque * math.sin(i), 30.0
            model.advance()
            outputs.append((model.output_angle, model.crank_torque, model.output_speed, model.max_contact_pressure))
        return outputs

    run(model, 0)
    state = model.state()
    wanted = run(model, steps)
    model.restore(state)
    other.restore(state)
    assert run(model, steps) == run(other, steps) == wanted
