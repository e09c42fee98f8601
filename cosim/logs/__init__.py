"""Measured logs: read, and held against themselves before they are believed."""
