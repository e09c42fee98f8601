"""A log replayed through an FMU: what it misses, and whether that is more than noise."""
