"""Contents of scenario files and start values."""
