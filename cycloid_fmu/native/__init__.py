"""FMUs that need no Python: tables of the contact model, the C around them, and their compilation."""
