"""Errors, units, text, arrays and entry points: what every room uses."""
