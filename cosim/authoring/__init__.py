"""Drafts, diagrams and SSP exports of scenarios, and runs of a single FMU."""
