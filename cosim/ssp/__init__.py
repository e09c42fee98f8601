"""SSP (System Structure and Parameterization): reading, flattening and writing systems of FMUs."""
