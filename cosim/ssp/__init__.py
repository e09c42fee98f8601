"""SSP: systems of FMUs as the System Structure and Parameterization standard has them, read, flattened and written."""
