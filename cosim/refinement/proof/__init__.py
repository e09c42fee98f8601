"""Proof of refined FMUs by replays of the logs, sealed logs included."""
