"""CAN buses: one reader per bus, which passes data frames to the channels in blocks."""
