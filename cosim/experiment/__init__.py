"""Experiments that separate rival hypotheses within limits."""
