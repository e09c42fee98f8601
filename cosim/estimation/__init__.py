"""Maximum likelihood estimation on measured logs: Kalman filter, noise, free parameters and score tests."""
