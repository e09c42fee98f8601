"""Comparison of runs with a baseline: differences of signals, inputs and criteria, and the page."""
