"""Maximum likelihood on measured logs: filter, noise, free parameters and score tests."""
