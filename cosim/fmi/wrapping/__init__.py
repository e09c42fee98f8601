"""Wrapped FMUs: the original binary with added terms."""
