"""Drives in time for the tests: variables as attributes, a step in one call."""

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
