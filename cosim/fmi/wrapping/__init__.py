"""Wrapped FMUs: the original binary, to which a library adds terms."""
