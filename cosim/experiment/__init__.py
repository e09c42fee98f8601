"""Experiments: the input that drives rival hypotheses apart, within limits."""
