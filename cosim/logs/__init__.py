"""Measured logs: reading and consistency checks."""
