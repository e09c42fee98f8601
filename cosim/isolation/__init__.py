"""Worker processes for FMUs, which are supervised, so that a crash of an FMU does not end cosim."""
