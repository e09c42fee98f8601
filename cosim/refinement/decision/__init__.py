"""Evidence, verdict and sentence of a refine."""
