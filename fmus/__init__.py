"""The FMUs: FMI variables over the plant and the controller, and their build."""

__version__ = "0.1.0"
