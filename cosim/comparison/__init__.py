"""Comparison of runs with a baseline: differences of all signals, inputs and criteria side by side, and the page."""
