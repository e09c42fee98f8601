"""Refined FMUs, replayed on the logs, sealed ones included."""
