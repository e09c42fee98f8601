"""Consistency tests of estimators."""
