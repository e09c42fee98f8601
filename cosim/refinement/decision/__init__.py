"""Posterior probabilities, verdict and sentences of a refinement."""
