"""A power-train identified on a testing bench: five tests, played on the bench's FMU or measured."""
