"""Comparison of two runs: differences of all signals, criteria side by side, and the page."""
