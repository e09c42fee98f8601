"""Components, connections and stepping order of a scenario, with all signals in one row."""
