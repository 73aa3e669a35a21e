"""Error surfaces: what really was made of one pair, sampled from tolerances, measured, identified or worn."""
