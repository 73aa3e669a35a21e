"""What really was made: the kinds of error, error surfaces, drives drawn from tolerances or measured."""
