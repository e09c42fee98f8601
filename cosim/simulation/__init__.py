"""Runs of a scenario: reading, checking, simulation, results, manifest and report."""
