"""Supervised worker processes for FMUs, so that a crash of an FMU does not end cosim."""
