"""Search for missing effects: candidates, hypotheses and their fits."""
