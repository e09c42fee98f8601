"""Candidates, hypotheses and their fits."""
