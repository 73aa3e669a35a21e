"""Constants of the models in Python and in C; the native FMU's `constants.h` is generated from these lines."""

from __future__ import annotations

FRICTION_ELEMENTS = 5  # Maxwell-slip elements per flange: their piecewise linear loop is within 1 % of the smooth one
INPUT_PRESLIDING_ANGLE = 2e-3  # rad of flange_a over which friction builds up
OUTPUT_PRESLIDING_ANGLE = 2e-5  # rad of flange_b over which friction builds up
PRESLIDING_TIME = 2e-3  # s: damping of the elements over their stiffness; a host's torque is up to 1.5 steps late
YIELDING_TIME = 2e-5  # s: in Model Exchange, time constant of an element strained beyond its yield
YIELDING_SHARE = 0.01  # of the presliding angle: largest strain beyond the yield while it slides
INPUT_STRIBECK_SPEED = 2.0  # rad/s of flange_a at which the Stribeck extra has fallen to 1/e
OUTPUT_STRIBECK_SPEED = 0.05  # rad/s of flange_b for the same
REFERENCE_TEMPERATURE = 293.15  # K at which friction is stated
UNRATED_LOAD = 100.0  # N.m: replaces the rated torque if none is stated
MOST_LOAD_SHARE = 0.9  # largest load_share at flange_b: above, the drive would jam
FRICTION_ROUNDING = 1e-9  # of the torque or angle at which elements slide: nearer ones count as sliding
FRICTION_ITERATIONS = 40  # for the output angle of the kinematic interface
FRICTION_SHARE = 1e-10  # of the friction torque: its last change in these iterations
SUGGESTED_STEP = 1e-4  # s: of the compliant interface with both inertias outside
DAMPING_TIME = 1e-4  # s: default mesh damping over the stiffness at the rated torque
# Damping ratios of gear meshes (R. Kasuba and J. W. Evans, J. Mech. Des. 103 (1981) 398).
DAMPING_RATIOS = (0.03, 0.17)
LOSS_COLUMNS = 5  # columns of the loss table
LARGEST_TRANSMISSION_ERROR = 0.01  # rad: a larger deviation of the flanges is an error of the surrounding model
SUB_STEP = 0.2  # rad of phase of the internal inertias' fastest oscillation in one sub-step
MESH_STEP = 0.01  # rad of the crank in one sub-step of the internal inertias
MOST_SUB_STEPS = 200000  # largest number of sub-steps in a communication step
CRANK_STEP = 0.02  # rad of the crank in one part of a step for the dissipated energy
DEVIATION_STEP = 5e-6  # rad of the deviation for the same
MOST_PARTS = 100  # parts for the dissipated energy in each `largest_step` of a communication step
SAME_PLACE = 1e-8  # rad of the output: below it the mean of both ends' torques replaces an energy difference
LAST_CHANGE = 2e-14  # rad of the output: last change of a sub-step's solution, above its rounding
LAST_SHARE = 1e-6  # of the sub-step's displacement, for the same: Newton's next change would be its square
MOST_DOUBLED = 6  # doublings of that share from iteration to iteration, for the rounding of the contacts
MOST_ITERATIONS = 30  # for the solution of a sub-step
STAGE_STEP = 1e-13  # rad of the output: last step of the iteration for a reducer's crank angle
STAGE_SHARE = 1e-12  # of the torque: last change of the crank's torque in the same iteration
STAGE_ITERATIONS = 50  # of the iteration for a reducer's crank angle
STAGE_DIFFERENCE = 1e-6  # rad of the crank, for the derivative of its torque
STEP_TOLERANCE = 1e-9  # share by which a communication step may exceed `largest_step`
LARGEST_LOAD = 2.5  # times the rated torque: usual permitted momentary torque of reducers (emergency stop)
MOST_LOADS = 192  # largest number of nodes of the tables for one direction of torque
NO_PLAY = 1e-13  # rad: a smaller play in the tables counts as none
LEAST_COMPLIANCE = 1e-12  # rad/(N.m): lower bound, as the table's own may vanish between nodes
LAST_CELL_SHARE = 1e-9  # of a cell between two loads: the search ends with a step this short
DIFFERENCE_SPEED = 1e-2  # rad/s: least flange speed for the difference quotient of friction
DIFFERENCE_SHARE = 1e-7  # of a variable's nominal value: half the difference for the derivatives of other outputs
DIFFERENCE_ROTATION = 1e-9  # rad of the output, for the same
EVENT_INDICATORS = 5  # of a native FMU in Model Exchange
MOST_AGES = 17  # states of a life in the tables of a native FMU
MOST_LOSS_ROWS = 64  # of the loss table in a native FMU
TABLE_VERSION = 9  # of the file of tables
STATE_VERSION = 9  # of the native FMU's serialised state
