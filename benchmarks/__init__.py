"""Benchmarks of `make bench`; not installed."""
