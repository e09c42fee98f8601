"""Physics of the thrust-vectoring hovercraft: equations stand here once and need nothing but Python."""
