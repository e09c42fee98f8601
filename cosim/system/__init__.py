"""Components, wiring and order: a scenario as a row of signals."""
