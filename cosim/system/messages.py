"""Messages of a scenario's components, connections, schedule and events."""

from cosim.base.messages import Template

# Components
NO_FMU = Template("E-SYS-001", "no such FMU: {path}{cure}")
INTERFACE_NOT_OFFERED = Template("E-SYS-002", "{fmu} offers {interfaces} only")
NO_VARIABLE = Template("E-SYS-003", '{component} has no variable "{name}"{hint}')
NO_INPUT = Template("E-SYS-099", '{component} has no input "{name}"{hint}; feedthrough: names inputs')
NOT_SETTABLE = Template("E-SYS-004", "{name} is {kind}; it takes no start value")
VALUE_MISFIT = Template("E-SYS-005", "{name} is {value!r}; {reason}")
COUNT_NAME_TAKEN = Template(
    "E-SYS-006", '"{name}" is already the name of the output that counts the fixes; give the signal another name'
)
FIX_NAME_TAKEN = Template(
    "E-SYS-007",
    '"{name}" is already the name of an output with the fixes of another signal; give the signal another name',
)
FIX_RATE_TOO_HIGH = Template(
    "E-SYS-008",
    "rate is {rate:g} Hz, communication points come at {fastest:g} Hz; use at most {fastest:g} Hz, or a shorter step",
)
UNKNOWN_COMPONENT = Template("E-SYS-009", 'no component "{name}"{hint}')
NOTHING_RECORDED = Template(
    "W-SYS-010", "{name} has no inputs and outputs, so nothing of it is recorded; record: [{name}.*] does so"
)

# Keys of the scenario
RECORD_WITHOUT_COMPONENT = Template("E-SYS-011", 'no component "{name}"{hint}; write component.* or component.variable')
RECORD_WITHOUT_VARIABLE = Template("E-SYS-012", 'no variable "{pattern}"{hint}')
RECORD_WITHOUT_SIGNAL = Template("E-SYS-094", 'no signal matches "{pattern}"{hint}')
RECORD_TIME = Template("E-SYS-107", "{pattern} is the time, the first column of every result; leave it out")
NOT_RECORDED = Template("E-SYS-095", "{name} is not recorded, and the criterion needs it; add it to record: signals")
CHARTS_LEFT_OUT = Template(
    "N-SYS-096", "{count} of {total} signals are recorded; the report has no chart of the connections {names}"
)
PAGE_LEFT_OUT = Template(
    "N-SYS-097", "signals of the report's own sections on a component are not recorded; it shows the others only"
)
DESIGN_WITHOUT_FMU = Template("E-SYS-013", 'design is for component "{name}", which is no FMU of components')
UNKNOWN_SIGNAL = Template("E-SYS-014", 'no signal "{name}"{hint}')
RESULTS_TOO_LARGE = Template(
    "E-SYS-015",
    "leaves {rows:.3g} rows of {signals} signals, {gigabytes:.3g} GB, more than {limit:g} GB; run shorter or in longer "
    "steps",
)
STEP_NOT_OF_SAMPLING = Template(
    "E-SYS-016",
    "step is {step:g} s; {component} is sampled at {sample:g} s ({parameter}): set "
    "components.{component}.start.{parameter}, or step: {sample:g}",
)

# Step control
NO_OTHER_STEPS = Template(
    "E-SYS-051",
    "{component} takes steps of one length only, so that they cannot be controlled; give it a step of its own "
    "(components.{component}.step)",
)
NO_HALVING = Template("E-SYS-052", "estimator: halving is not possible: {reason}; leave estimator out, or set residual")
NO_OUTPUT_OF_BOND = Template("E-SYS-053", 'no connected output "{signal}"{hint}')
BOND_ONE_SIDED = Template("E-SYS-054", "{signal} is connected to no input of {owner}, the other side of the bond")
BOND_CONVERTS = Template(
    "E-SYS-055", "{signal} is converted on its way to {target}; a bond needs one unit on both sides"
)
COURSES_AND_EVENT_MODE = Template(
    "E-SYS-056",
    "{component} runs in event mode, with which inputs are held during a step; leave extrapolate and interpolate out, "
    "or set event_mode: false",
)

# Events
EVENT_OUTSIDE_RUN = Template("E-SYS-017", "{time:g} s is not within {start:g} … {end:g} s")
TWO_VALUES = Template("E-SYS-018", "two values at {time:g} s: {first!r} and {second!r}; keep one")
NO_FMU_OF_NAME = Template("E-SYS-019", 'no FMU "{name}" among the components{hint}')
NOT_CHANGEABLE = Template(
    "E-SYS-020", "{name} is a {variability} {causality}; inputs and tunable parameters change while it runs"
)
SET_AND_CONNECTED = Template(
    "E-SYS-021", "{name} is connected, which decides its value; use faults: for what disturbs a connection"
)

# Schedule
ALGEBRAIC_LOOP = Template(
    "E-SYS-022",
    "algebraic loop under {algorithm}: {cycle}; each needs the other's value of the same time. State their order "
    "(order: [{names}]) or algorithm: {other}",
)
ORDER_AND_LOOPS = Template(
    "E-SYS-046", "order states which values are of the last step, loops solves for all of the same time; leave one out"
)
NO_LOOPS = Template("E-SYS-047", "{algorithm} solves no algebraic loops; leave loops out, or set algorithm: {other}")
OWN_STEP_IN_LOOP = Template(
    "E-SYS-048", "{component} has a step of its own, and is part of the algebraic loop {loop}; leave its step out"
)
EVENT_MODE_IN_LOOP = Template(
    "E-SYS-050",
    "{component} is part of the algebraic loop {loop} and runs in event mode, in which it cannot be solved; set "
    "event_mode: false, or state the order of the components (order: [...]), which leaves it open",
)
EXCHANGE_IN_LOOP = Template(
    "E-SYS-098",
    "{component} is part of the algebraic loop {loop} and uses model exchange, beside an FMU in event mode; choose "
    "interface: co-simulation, or state the order of the components (order: [...]), which leaves it open",
)
LOOP_OF_NO_REALS = Template(
    "E-SYS-049",
    "{signal} is part of an algebraic loop and {type}; only real signals are solved. State the order of the components "
    "(order: [...]), so that it has the value of the last step",
)
LEFT_OPEN = Template(
    "W-SYS-100",
    "{loop} may be an algebraic loop, which {by} leaves open, so that some inputs have the values of the step before; "
    "{cure}",
)
NO_LOOP_AT_START = Template(
    "N-SYS-103",
    "{loop} is no algebraic loop at the start, as measured or stated by feedthrough: [...]; if outputs follow inputs "
    "at once later, {cure}",
)
LOOPS_SOLVES = Template("N-SYS-101", "loops: {{}} without {key} solves it, if it has a solution")
LOOPS_NEED_STATES = Template(
    "N-SYS-104",
    "loops: {{}} without {key} solves it, if it has a solution and outputs of {names}, which cannot save a state, "
    "follow inputs without a step",
)
LOOPS_REFUSED = Template("N-SYS-105", "loops: {{}} without {key} is refused: {fault}")
LOOP_BY_FEEDTHROUGH = Template(
    "N-SYS-102",
    "{loop} is an algebraic loop that no FMU declares: outputs follow {inputs} at once, as measured before the run or "
    "stated by feedthrough: [...]. It is solved at each communication point; order: [...] leaves it open",
)
PLAN_INCOMPLETE = Template("E-SYS-023", "{algorithm} steps {order}; it must step each component once")
STEP_NOT_A_MULTIPLE = Template(
    "E-SYS-024", "step is {step:g} s, that of the scenario {base:g} s; use a whole multiple, {cure:g} s for one"
)
STEP_LONGER_THAN_RUN = Template("E-SYS-025", "step is {step:g} s, the run {duration:g} s: it would never step")
LAST_STEP_INCOMPLETE = Template(
    "W-SYS-026",
    "{component}: step is {step:g} s; its last {rest:g} s of the run make no whole step: it stands still there",
)
ORDER_INCOMPLETE = Template("E-SYS-027", "order names every component with inputs once; missing: {missing}")

# Connections
NOT_AN_ITEM = Template("E-SYS-028", "{value:g}, which comes from {origin}, is none of its items: {items}")
TYPE_MISMATCH = Template("E-SYS-029", "types do not agree: {source} is {source_type}, {target} is {target_type}")
ITEM_MISMATCH = Template(
    "E-SYS-030",
    "enumerations of one name, {name}, with other items: {source} has {source_items}, {target} has {target_items}",
)
UNIT_MISMATCH = Template(
    "E-SYS-031",
    "unit mismatch: {source} [{source_unit}] to {target} [{target_unit}]; where they are the same all the same, say so "
    "by factor: 1",
)
UNIT_DEFINITION_MISMATCH = Template(
    "E-SYS-110",
    "unit mismatch: {source} and {target} are both in [{unit}], which their FMUs define with different dimensions; "
    "where they are the same all the same, say so by factor: 1",
)
SIZE_MISMATCH = Template("E-SYS-032", "{source} to {target}: {count} values do not go to {target_count}")
UNCHANGEABLE_TYPE = Template("E-SYS-033", "{source} to {target}: no {changes} on {type}")
WRONG_END = Template("E-SYS-034", "{signal} is one of the {side} of {component}; an output goes to an input")
ONLY_RECORDED = Template("E-SYS-035", "{signal} is recorded, but no output of {component}; an output goes to an input")
UNKNOWN_END = Template("E-SYS-036", '{component} has no {side} "{name}"{hint} (its {side}s: {names})')
SEVERAL_SOURCES = Template("E-SYS-037", "two sources for {target}: {first} and {second}; keep one")
SOURCES_OF_ALIASES = Template(
    "E-SYS-111", "{target} and {other} are one variable of the FMU with two sources: {source} and {first}; keep one"
)
INPUTS_NOT_CONNECTED = Template("W-SYS-039", "not connected, at the start value of the FMU: {names}")
FIXES_NOT_CONNECTED = Template("W-SYS-040", "inputs not connected, so their fixes are 0: {names}")

# Injected faults
FAULT_NOT_ON_CONNECTION = Template("E-SYS-041", "no connection to {target}{hint}")
FAULT_ON_OWN_STEP = Template(
    "E-SYS-042",
    "{target} is of a component with a step of its own; faults act on components that step with the scenario",
)
FAULT_WITHOUT_KEY = Template("E-SYS-043", "{kind} needs {key}; add it")
FAULT_OUTSIDE_RUN = Template("E-SYS-044", "acts at no communication point of {start:g} … {end:g} s")
DELAY_ROUNDED = Template(
    "W-SYS-045", "a delay of {delay:g} s on {target} is no whole number of steps: it is {rounded:g} s"
)

# Event mode and clocks
NO_EVENT_MODE = Template("E-SYS-071", "{component} has no event mode: {reason}")
NO_CLOCK = Template("E-SYS-072", '{component} has no input clock "{name}"{hint}')
CLOCK_WITHOUT_EVENT_MODE = Template(
    "E-SYS-073", "{component} ticks no clocks without event mode; leave out event_mode: false"
)
CLOCK_TIME_OF_FMU = Template(
    "E-SYS-074", "{name} is a {kind} clock, whose FMU gives its times; leave out its times in the scenario"
)
CLOCK_WITHOUT_SHIFT = Template(
    "E-SYS-075", "{name} is a {kind} clock: give its interval only; only triggered clocks have shift: and at:"
)
CLOCK_NEEDS_ONE = Template("E-SYS-076", "{name} needs either interval: or at:")
CLOCK_TIMES_UNORDERED = Template("E-SYS-077", "the times of {name} are not in order, from the start of the run on")
CLOCK_TWICE = Template("E-SYS-078", "{name} has times in the scenario and a connection; keep one")
CLOCK_CHANGED = Template("E-SYS-079", "{source} to {target}: no factor, offset, noise or fault acts on a clock")
CLOCK_NEVER_TICKS = Template(
    "W-SYS-080", "{names}: never ticks; connect it to an output clock, or give its times under clocks:"
)
EVENTS_AT_POINTS = Template(
    "W-SYS-082",
    "{component} {reason}: an event within a step reaches it at the end of the step",
)
NO_CLOCKS = Template("E-SYS-083", "{component} has no clocks; leave out clocks:")
CLOCK_NOT_TUNABLE = Template(
    "E-SYS-084", "{name} is a clock whose interval cannot be set; a tunable clock with intervalDecimal takes one"
)
NO_INTERVAL = Template("E-SYS-085", "{name} is {value!r}; give the interval of the clock, a time above 0 s")
