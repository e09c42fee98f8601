"""Scenario runs: from reading and checking to results, manifest and report."""
