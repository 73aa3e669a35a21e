"""Forms of a compensator: C99 source, IEC 61131-3 Structured Text, FMUs and a look-up table."""
