"""A first scenario, its picture, its SSP, and one FMU without a scenario."""
