"""Distributions for users: their build, and trials of them in empty environments. Not installed."""
