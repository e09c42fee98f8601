"""Replays of a log through an FMU, and the comparison of their errors with noise."""
