"""Estimators held against what they believe."""
