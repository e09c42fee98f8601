"""A model about a point: A, B, C and D, what they tell of it, and who takes them."""
