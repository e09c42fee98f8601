"""Coupling algorithms: the order of components and the times of copying outputs to inputs."""
