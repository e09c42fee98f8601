"""Messages of probing."""

from cosim.base.messages import Template

DERIVATIVES_WITHOUT_STATES = Template(
    "E-PRB-001", "does not declare the state of every derivative; probe its co-simulation, or export it again"
)
NO_INTERFACE = Template("E-PRB-002", "has no usable interface for {way}; it offers {ways}")
UNKNOWN_VALUE = Template("E-PRB-003", 'has no variable "{name}"{cure}')
TOO_SHORT = Template("E-PRB-004", "the log has too few rows to probe the FMU; give a longer one")

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
