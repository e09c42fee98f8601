"""Evidence, verdict and sentence of a refinement."""
