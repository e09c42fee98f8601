"""Messages of linearizations."""

from cosim.base.messages import Template

# -- operating point: --at, --component, --side

AT_WITHOUT_VALUE = Template(
    "E-LIN-001", "{text} is neither NAME=VALUE of a state or input, such as level=0.5, nor SCENARIO.yaml@TIME"
)
INVALID_TIMES = Template("E-LIN-002", "{text}: {reason}")
REPEATED_VALUE = Template("E-LIN-003", "{name} is given twice, {first} and {second}; give it once")
SEVERAL_SCENARIOS = Template("E-LIN-004", "{count} scenarios are named; name one")
UNKNOWN_SIGNAL = Template(
    "E-LIN-005", '{model} has no state or input "{name}"{cure} (states: {states}; inputs: {inputs})'
)
INVALID_VALUE = Template("E-LIN-006", "{name}={value}: {reason}")
NO_SCENARIO = Template("E-LIN-007", "no such scenario; check its path")
TIME_OUTSIDE = Template("E-LIN-008", "{time:g} s is not within {scenario}, which runs from {first:g} to {last:g} s")
UNKNOWN_COMPONENT = Template("E-LIN-009", '{scenario} has no component "{name}" ({names})')
SEVERAL_COMPONENTS = Template("E-LIN-010", "several components fit the model: {names}; choose one as --component NAME")
NO_COMPONENT_FITS = Template(
    "E-LIN-011", "no component of {scenario} has the inputs and outputs of {model} ({missing}); name another scenario"
)
COMPONENT_MISFIT = Template(
    "E-LIN-012", "{component} lacks inputs and outputs of {model} ({missing}); name another component"
)
STATES_NOT_RECORDED = Template("E-LIN-013", "{component} of {scenario} records no {names}")
UNKNOWN_SIDE = Template("E-LIN-014", '"{side}" is not a side of a kink; give below or above{cure}')
NO_DERIVATIVE = Template(
    "E-LIN-015", "{kink}; there is no derivative: choose --side below or --side above, or give a point next to it"
)

# -- model and selection: --set, --step, --states, --inputs, --outputs, --residualize

NOT_NAME_VALUE = Template("E-LIN-016", "{text} is not NAME=VALUE; for example mass=2")
UNKNOWN_PARAMETER = Template("E-LIN-017", '{model} has no parameter "{name}"{cure}')
UNSUITABLE_PARAMETER = Template("E-LIN-018", "{owner}{fault}; correct this value")
STEP_OF_EQUATIONS = Template("E-LIN-019", "is of FMUs only: equations are differentiated exactly; leave it out")
STEP_SIZE = Template("E-LIN-020", "{step:g} is not between 0 and 1; give a small number, such as 1e-5")
UNKNOWN_NAME = Template("E-LIN-021", '{model} has no {kind} "{name}"{cure}')
REPEATED_NAME = Template("E-LIN-022", "{name} is named twice; name it once")
SELECTED_AND_ELIMINATED = Template("E-LIN-023", "{name} is also selected by --states; name it in one of the two")
STATES_MISSING = Template(
    "E-LIN-024",
    "the selected states depend on {names}; add them, or, if they settle at once, name them as --residualize",
)
NO_STEADY_STATE = Template(
    "E-LIN-025",
    "{names} cannot be residualized: they do not settle while the other states are constant (their block of A is "
    "singular); leave out states that only integrate",
)
NO_EQUILIBRIUM = Template(
    "E-LIN-026",
    "{names} cannot be residualized: no values were found at which they are at rest while the other states are "
    "constant; name other states, or another operating point",
)
CO_SIMULATION_ONLY = Template(
    "E-LIN-027",
    "is for co-simulation only, and hides its states and derivatives; give the model's own file (model.yaml, "
    "file.py:Class or base), or an FMU for model exchange; `cosim build --native` makes one of any model here",
)
DERIVATIVES_WITHOUT_STATES = Template(
    "E-LIN-028", "declares derivatives without their states; its modelDescription.xml needs the attribute `derivative`"
)
UNKNOWN_VARIABLE = Template("E-LIN-029", 'has no variable "{name}"{cure}')
NOT_SETTABLE = Template(
    "E-LIN-030", "{name} is {kind} without a start value, so it cannot be set; name a parameter, a state or an input"
)
UNSUITABLE_START = Template("E-LIN-031", "{name} is {value!r}; {reason}")

# -- reasons of a failure at a point

NO_VALUE_AT_POINT = Template("E-LIN-032", "the equations have no value there: {reason}")
NOT_FINITE_AT_POINT = Template(
    "E-LIN-033",
    "the derivatives, the outputs or their slopes are not finite at this point; choose another operating point",
)

# -- remarks on a result

OTHER_MODEL = Template("W-LIN-034", "{component} is not this model: driven alike, {output} differs by up to {size}")
SLOPES_WITHDRAWN = Template(
    "W-LIN-035", "finite differences of step {step:g} replace the FMU's own derivatives: {reason}"
)
SLOPES_REPLACED = Template(
    "W-LIN-036", "differences of step {step:g} are taken for {rows}: the FMU's own slopes of these differ"
)
STATES_MOVED = Template("N-LIN-037", "an event of the FMU at this point has moved its states: {states}")
EARLIER_POINT = Template("N-LIN-038", "a time between two communication points is moved to the earlier of the two")
INPUTS_SHAPED = Template("N-LIN-039", "{effect} ({equation}) acts on the inputs before they get here and is left out")
ONE_SIDED = Template("N-LIN-040", "the equations end at this point: to one side of it they have no value")
IDLE_INPUT = Template("N-LIN-041", "{name} moves nothing at this point: a dead band or a stop, perhaps")
SIDE_OF_KINK = Template("N-LIN-042", "{kink}; the slopes here are those {side}")
MORE_KINKS = Template("N-LIN-043", "{count} kinks more; linear.json has all")
SIDE_WITHOUT_EFFECT = Template(
    "N-LIN-044",
    "--side {side} has no effect: the chosen states, inputs and outputs have the same slopes on both sides here",
)
