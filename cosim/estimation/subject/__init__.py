"""Objects that can be refined: the interface of fits and proofs, and its implementation by a model."""
