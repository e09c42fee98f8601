"""Measured logs: reading them, and checking their consistency."""
