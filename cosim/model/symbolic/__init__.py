"""Symbolic equations: linear models, dependencies and generated code."""
