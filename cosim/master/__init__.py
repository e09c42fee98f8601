"""The master: initialization of systems, stepping in Python and C, and observers."""
