"""CAN buses: one reader for each, data frames in blocks to the channels."""
