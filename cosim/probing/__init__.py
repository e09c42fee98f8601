"""Properties of an FMU measured by simulation: structure, places where terms can act, and misbehaviour."""
