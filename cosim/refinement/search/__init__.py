"""Search for missing effects: sets of candidates and their fits."""
