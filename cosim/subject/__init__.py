"""Objects that can be refined: the interface that fits and proofs ask, and the implementation by a model."""
