"""Messages of stepping: initialization, events and clocks, early ends, observers, disk space."""

from cosim.base.messages import Template

NOT_SETTLED = Template(
    "E-MAS-001",
    "it still changes after {count} exchanges of initialization: an algebraic loop that exchanging values does not "
    "settle; an FMU without direct feedthrough in the loop breaks it",
)
OPEN_SETTLES = Template(
    "N-MAS-068",
    "order: [...] or algorithm: jacobi leaves it open, with values of the step before, which settle (the loop gain is "
    "{gain:.3g})",
)
OPEN_GROWS = Template(
    "N-MAS-069",
    "order: [...] or algorithm: jacobi is no cure: with values of the step before, they grow (the loop gain is "
    "{gain:.3g}). The loop needs an FMU that saves and restores its state, or one without direct feedthrough",
)

# Events and clocks

# Real time
