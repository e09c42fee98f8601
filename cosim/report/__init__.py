"""Plots, tables and templates of every page, independent of its subject."""
