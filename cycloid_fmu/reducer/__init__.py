"""The RV reducer: its first stage, and the budget of its lost motion."""
