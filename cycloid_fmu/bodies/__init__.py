"""Elastic bodies: displacements of discs, pins, cranks, carrier and ring under unit loads, as influence matrices."""
