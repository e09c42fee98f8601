"""Replays of a log through an FMU, and comparison of their errors with the noise."""
