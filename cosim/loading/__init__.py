"""Which model is meant, and whether it is sound."""
