"""Identification of a power-train on a testing bench from five tests, simulated or measured."""
