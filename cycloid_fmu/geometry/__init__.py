"""The gear pair as drawn: values, validation and the flank's profile."""
