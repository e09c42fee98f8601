"""Charts within the output of a notebook's cell."""
