"""Export of discs: the outline as made, in arcs, and files for CAD, CAM and measuring machines."""
