"""Measured logs, a model, and what the model lacks: fit, attribution, verdict, proof."""
