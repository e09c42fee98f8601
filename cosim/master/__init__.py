"""The steps of a system: initialization, the loops in Python and C, observers."""
