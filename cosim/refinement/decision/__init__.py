"""Posterior, verdict and sentence of a refinement."""
