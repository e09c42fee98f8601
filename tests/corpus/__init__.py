"""The corpus: one list of commands, run with the wheels of two revisions, and the comparison of their outcomes."""
