"""Coupling algorithms: the order of components, and when outputs are copied to inputs."""
