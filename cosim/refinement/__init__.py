"""Refinement of a model from measured logs: search for hypotheses, decision, and replays that prove the result."""
