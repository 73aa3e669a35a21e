"""Numbers of the models in Python and in C; the native FMU's `constants.h` is made of these lines."""

from __future__ import annotations

FRICTION_DISPLACEMENT = 2e-5  # rad of the output over which the compliant interface's dry friction builds up
DAMPING_TIME = 1e-4  # s: default mesh damping over the stiffness at the rated torque
LOSS_SPEED = 1e-2  # rad/s of flange_a below which the losses' torque goes to zero with the speed
LOSS_COLUMNS = 5  # of the loss table
LARGEST_TRANSMISSION_ERROR = 0.01  # rad: flanges beyond it are a mistake of the model around the drive
SUB_STEP = 0.2  # rad of the fastest oscillation of the inertias inside in one sub-step
MESH_STEP = 0.01  # rad of the crank in one sub-step of the inertias inside
MOST_SUB_STEPS = 200000  # in a communication step
CRANK_STEP = 0.02  # rad of the crank in one sub-step of what is dissipated
DEVIATION_STEP = 5e-6  # rad of the deviation likewise
MOST_PARTS = 100  # of what is dissipated in each `largest_step` of a communication step
SAME_PLACE = 1e-8  # rad of the output: over less the mean of both ends' torques replaces an energy difference
LAST_CHANGE = 2e-14  # rad of the output: last change of a sub-step's solution; its rounding is below
LAST_SHARE = 1e-6  # of the sub-step's way, likewise: Newton's next change would be its square
MOST_DOUBLED = 6  # times that share is doubled from change to change, as contacts have a rounding of their own
MOST_ITERATIONS = 30  # of a sub-step's solution
STAGE_STEP = 1e-13  # rad of the output: last step of the iteration for a reducer's crank angle
STAGE_SHARE = 1e-12  # of the torque: last change of the crank's torque, likewise
STAGE_ITERATIONS = 50  # for a reducer's crank angle
STAGE_DIFFERENCE = 1e-6  # rad of the crank, for the change of its torque
STEP_TOLERANCE = 1e-9  # share by which a communication step may exceed `largest_step`
LARGEST_LOAD = 2.5  # times the rated torque: what reducers' makers allow for a moment (emergency stop)
MOST_LOADS = 192  # nodes of one direction of torque in the tables
NO_PLAY = 1e-13  # rad: less of it in the tables is none
LEAST_COMPLIANCE = 1e-12  # rad/(N.m): between nodes a table may have none
LAST_CELL_SHARE = 1e-9  # of a cell between two loads: a step of the search this short is the last
DERIVATIVE_SHARE = 1e-7  # of torque and speed: half the difference that gives the losses' derivative
DIFFERENCE_SHARE = 1e-7  # of a variable's nominal size: half the difference that gives other outputs' derivatives
DIFFERENCE_ROTATION = 1e-9  # rad of the output, likewise
EVENT_INDICATORS = 5  # of a native FMU in Model Exchange
MOST_LOSS_ROWS = 64  # of the loss table in a native FMU
TABLE_VERSION = 6  # of the file of tables
STATE_VERSION = 5  # of the native FMU's serialised state
