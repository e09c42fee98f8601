"""Scenario drafts, diagrams and SSP exports, and runs of a single FMU."""
