"""Terms that an FMU may lack."""
