"""Forms of a compensator: C99 source, FMUs and a look-up table."""
