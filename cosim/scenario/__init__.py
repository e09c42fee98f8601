"""Content of a scenario file, start values, and the design of its controller."""
