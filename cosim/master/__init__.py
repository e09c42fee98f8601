"""Stepping of systems: initialization, loops in Python and C, and observers."""
