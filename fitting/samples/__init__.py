"""Samples of recordings, whatever file they come from: one clock, unwrapped angles, gaps, plausibility."""
