"""The standard figures: lost motion, backlash, stiffness, transmission error and starting torques."""
