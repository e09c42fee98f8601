"""Benchmarks that `make bench` runs; not installed."""
