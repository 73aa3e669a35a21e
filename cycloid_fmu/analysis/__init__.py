"""A drive over crank angles, whatever holds its gear: rigid bearings, stated ones, or cranks behind a first stage."""

from cycloid_fmu.analysis.dataset import analyze as analyze
from cycloid_fmu.analysis.dataset import labelled as labelled
from cycloid_fmu.analysis.dataset import labelled_losses as labelled_losses
from cycloid_fmu.analysis.dataset import statistics as statistics
from cycloid_fmu.analysis.shares import compliance as compliance
from cycloid_fmu.analysis.shares import series_compliance as series_compliance
from cycloid_fmu.analysis.solver import error_sensitivity as error_sensitivity
from cycloid_fmu.analysis.solver import lost_motion as lost_motion
from cycloid_fmu.analysis.solver import sensitivity as sensitivity
from cycloid_fmu.analysis.solver import solve as solve
from cycloid_fmu.analysis.validity import interference_notes as interference_notes
from cycloid_fmu.analysis.validity import notes as notes
from cycloid_fmu.analysis.validity import step_notes as step_notes
from cycloid_fmu.analysis.validity import tilt_notes as tilt_notes
