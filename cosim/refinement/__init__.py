"""Refinement of a model from measured logs: fit, attribution, verdict and proof."""
