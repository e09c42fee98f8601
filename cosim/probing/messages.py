"""Messages of probing."""

from cosim.base.messages import Template

DERIVATIVES_WITHOUT_STATES = Template(
    "E-PRB-001", "does not declare the state of every derivative; probe its co-simulation, or export it again"
)
NO_INTERFACE = Template("E-PRB-002", "has no usable interface for {way}; it offers {ways}")
UNKNOWN_VALUE = Template("E-PRB-003", 'has no variable "{name}"{cure}')
TOO_SHORT = Template("E-PRB-004", "the log has too few rows to probe the FMU; give a longer one")

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
INSTANCES_DISTURB = Template(
    "W-PRB-009",
    "two instances in one process disturb each other: {output} differs by {difference:.3g}; each needs a process of "
    "its own",
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
STAIRS = Template(
    "W-PRB-013",
    "its outputs change only every {own:.3g} s or so, with steps of {step:.3g} s; use steps of whole {own:.3g} s",
)
ROLLBACK_FAILS = Template(
    "W-PRB-014",
    "does not come back to a saved state: {output} differs by {difference:.3g} when the same steps are repeated; "
    "steps are never repeated",
)
ROLLBACK_REFUSED = Template("W-PRB-015", "declares that its state can be saved, but refuses it: {reason}")
EVENTS_ALWAYS = Template(
    "W-PRB-016",
    "has events in model exchange at every step: {count} {kind} events in {steps} steps; a filter over its states "
    "is not possible, its co-simulation is used if it has one",
)
NO_PARAMETERS = Template(
    "W-PRB-017", "has no real parameter that may be set before initialization; only terms can be added to it"
)
NO_UNITS = Template("W-PRB-018", "declares no unit; numbers are taken as they are")
ENDS_EARLY = Template("N-PRB-019", "{error}; its behaviour is tried before that time")
PROBE_FAILED = Template("W-PRB-020", "{error} (while {probe} was tried)")
VALUE_FAILED = Template("W-PRB-021", "{error} (with {name} = {value:g}; its value in the file is {start:g})")
RUN_ENDS = Template("W-PRB-022", "{error}; the structure is that before it")

# Reasons for the interface by which an FMU is refined
EXCHANGE_FITS = Template(
    "N-PRB-023",
    "its states and derivatives are accessible, no events occur along the logs, and step times largest eigenvalue is "
    "{stiffness:.2g}, at most {most:g}",
)
EVENTS_ON_LOGS = Template("N-PRB-024", "model exchange has {count} events along the logs")
TOO_FAST = Template("N-PRB-025", "step times largest eigenvalue is {stiffness:.3g} in model exchange, above {most:g}")
NO_STATES = Template("N-PRB-026", "model exchange has no continuous states")
ONLY_CO_SIMULATION = Template("N-PRB-027", "it has no model exchange")
NO_USABLE_EXCHANGE = Template("N-PRB-028", "its model exchange fails: {error}")
ONLY_EXCHANGE = Template("N-PRB-029", "it has no co-simulation, although {objection}")
OWN_STEP_TOO_LONG = Template(
    "N-PRB-030", "its co-simulation has steps of its own of {own:.3g} s, above those of the logs, although {objection}"
)

NOT_IN_STEP = Template(
    "W-PRB-031",
    "{parameter} brakes {velocity} and would tell how forces there change other rates, but a second instance cannot be "
    "kept in step: events occur, or a process holds one instance only; forces at {velocity} act through an input, or "
    "on its rate alone",
)
