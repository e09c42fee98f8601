"""A scenario run: read, checked, laid out, stepped by the master, written down and shown."""
