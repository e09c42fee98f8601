"""Physics of the thrust-vectoring hovercraft: all equations, with Python's standard library only."""
