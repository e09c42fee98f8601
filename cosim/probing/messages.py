"""Messages of probing."""

from cosim.base.messages import Template

# Findings about the behaviour of a binary
IDLE_RESET = Template(
    "W-PRB-005",
    "{function} returns OK but does not restore the start: {output} differs by {difference:.3g} in the next "
    "simulation; it is instantiated again for every simulation",
)
RESET_REFUSED = Template("N-PRB-006", "refuses a reset ({reason}); it is instantiated again for every simulation")
FORGETS_EARLY = Template(
    "W-PRB-007",
    "forgets parameters that are set before initialization mode ({names}); they are set again inside it",
)
TWO_RUNS_DIFFER = Template(
    "W-PRB-008",
    "two simulations with equal values differ: {output} by {difference:.3g}, {share:.2g} of its largest value; "
    "no estimate is more accurate than that",
)
FOLDER_MATTERS = Template(
    "W-PRB-010",
    "depends on the {folder}: {output} differs by {difference:.3g} in another one",
)
GROWS = Template(
    "W-PRB-011", "keeps {size:.2g} MB of memory for each instance after its end; {count} instances need {total:.2g} GB"
)
OWN_STEP = Template(
    "W-PRB-012",
    "makes steps of its own of about {own:.3g} s, above the step of {step:.3g} s that is asked for: its results are "
    "wrong there; use model exchange, or steps of whole {own:.3g} s",
)
ROLLBACK_FAILS = Template(
    "W-PRB-014",
    "does not come back to a saved state: {output} differs by {difference:.3g} when the same steps are repeated; "
    "steps are never repeated",
)
EVENTS_ALWAYS = Template(
    "W-PRB-016",
    "has events in model exchange at every step: {count} {kind} events in {steps} steps; a filter over its states "
    "is not possible, its co-simulation is used if it has one",
)
NO_PARAMETERS = Template(
    "W-PRB-017", "has no real parameter that may be set before initialization; only terms can be added to it"
)
NO_UNITS = Template("W-PRB-018", "declares no unit; numbers are taken as they are")
VALUE_FAILED = Template("W-PRB-021", "{error} (with {name} = {value:g}; its value in the file is {start:g})")

# Reasons for the interface by which an FMU is refined
EXCHANGE_FITS = Template(
    "N-PRB-023",
    "its states and derivatives are accessible, no events occur along the logs, and step times largest eigenvalue is "
    "{stiffness:.2g}, at most {most:g}",
)
EVENTS_ON_LOGS = Template("N-PRB-024", "model exchange has {count} events along the logs")
TOO_FAST = Template("N-PRB-025", "step times largest eigenvalue is {stiffness:.3g} in model exchange, above {most:g}")
ONLY_CO_SIMULATION = Template("N-PRB-027", "it has no model exchange")
ONLY_EXCHANGE = Template("N-PRB-029", "it has no co-simulation, although {objection}")

NOT_IN_STEP = Template(
    "W-PRB-031",
    "{parameter} brakes {velocity} and would tell how forces there change other rates, but a second instance cannot be "
    "kept in step: events occur, or a process holds one instance only; forces at {velocity} act through an input, or "
    "on its rate alone",
)
