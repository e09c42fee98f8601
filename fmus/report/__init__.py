"""The hovercraft's part of a run's page."""
