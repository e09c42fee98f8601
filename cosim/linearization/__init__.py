"""Linear models A, B, C and D at a point, their properties, and their files."""
