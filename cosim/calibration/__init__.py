"""Maximum-likelihood estimates of the parameters and start values of any FMU from measured logs."""
