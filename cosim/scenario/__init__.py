"""Contents of scenario files, start values and controller design."""
