"""Live page of a running command: rows, runs or rankings so far, changes and stop."""
