"""Error surfaces: the actual errors of one pair, sampled from tolerances, measured, identified or worn."""
