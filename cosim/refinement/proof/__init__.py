"""Replays of all logs through the refined FMU, including sealed logs, which prove the result."""
