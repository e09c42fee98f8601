"""Subjects, which are objects that can be refined: the interface, and its implementations for models and FMUs."""
