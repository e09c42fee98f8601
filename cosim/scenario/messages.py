"""Messages of scenarios, their start values and their controller designs."""

from cosim.base.messages import Template

# -- form -----------------------------------------------------------------------------------------
NO_START_VALUE = Template("E-SCN-001", "a start value is a finite number, true or false, or text such as 12 deg")
FIRST_FAULTS = Template("E-SCN-002", "the first {limit} faults are shown")
MANY_STEPS = Template(
    "E-SCN-003",
    "step is {step:g} s, which makes {count:.3g} steps, and a run may have {limit:g}; give a longer step or a "
    "shorter duration",
)
STEP_NOT_A_DIVISOR = Template(
    "E-SCN-004",
    "step is {step:g} s; use a whole divisor of duration {duration:g} s, {divisor:.6g} s for one",
)
EVERY_NO_MULTIPLE = Template(
    "E-SCN-052", "{every:g} s is no whole number of steps of {step:g} s; use for example {near}"
)
EVERY_TOO_LONG = Template("E-SCN-053", "{every:g} s is longer than the run, {duration:g} s; use a shorter time")
CONTROL_OUT_OF_ORDER = Template(
    "E-SCN-021",
    "min is {min:g} s, max {max:g} s and rows {rows:g} s; min is at most max, and max at most rows",
)
BONDS_WITHOUT_ENERGY = Template(
    "E-SCN-022", "bonds belong to estimator: energy, which this is not ({estimator}); leave one of them out"
)
ENERGY_WITHOUT_BONDS = Template("E-SCN-023", "estimator: energy needs bonds: [{{effort: a.force, flow: b.velocity}}]")
MIN_BELOW_RESOLUTION = Template(
    "E-SCN-024",
    "min is {min:g} s, too short for floating-point times of this run; give at least {resolution:.2g} s",
)
NO_BAND = Template("E-SCN-005", "{kind} needs a band; add the allowed distance from its target")
NEEDLESS_BAND = Template("E-SCN-006", "{kind} takes no band; leave it out")
INTERVAL_OUTSIDE = Template(
    "E-SCN-007",
    "{kind} looks from {start:g} s to {end:g} s of {duration:g} s; choose times within the run, a step or more apart",
)
UNKNOWN_UNIT = Template("E-SCN-008", "{name} is {value}: the unit of {signal} is not known; write a number alone")

# -- overrides ------------------------------------------------------------------------------------
OVERRIDE_WITHOUT_VALUE = Template("E-SCN-009", "{override} is not path=value; for example --set noise=off")
OVERRIDE_OF_NO_COMPONENT = Template(
    "E-SCN-010",
    '{override} is for component "{name}", which is not in the scenario{hint} (its components: {components})',
)
OVERRIDE_OF_NOTHING = Template("E-SCN-011", "{override} leads nowhere: there is no {path} in the scenario")

# -- refined models -------------------------------------------------------------------------------
NEAREST_OF_MANIFEST = Template(
    "E-SCN-012",
    "a manifest repeats its run as it was; leave --nearest out, or run the scenario",
)
NO_REFINED_MODEL = Template(
    "E-SCN-013",
    "no component or design uses a result of `cosim refine`, so --nearest has no effect; name the FMU or the "
    "model.yaml of such a result, or leave --nearest out",
)
NEAREST_WITHOUT_MODEL = Template("E-SCN-014", "nearest is of a refine; name its folder as model")

# -- controller design ----------------------------------------------------------------------------
NO_COMPLEX_NUMBER = Template("E-SCN-015", "{value} is no number; write -4 or, complex, -4+1j")
CRASHED_PYTHON = Template("E-SCN-016", "does not load: {reason}")
CONTRADICTION = Template("E-SCN-017", "{name} is {start} here and {option} in design: leave one of them out")
MODEL_WITHOUT_DESIGNER = Template("E-SCN-018", "{name} is {title}; no controller is designed for it here")
NO_DESIGN = Template("E-SCN-019", "design: {error}")
TWO_NUMBERS = Template(
    "W-SCN-020",
    "{name} is {start:g} in components.{component}.start and {design:g} in design: it runs with the first and"
    " is designed with the second",
)
FORMS_OF_RECORD = Template(
    "E-SCN-025",
    "it should be a list of patterns of locals and parameters to record beside inputs and outputs, [plant.*], or a "
    "mapping that limits the record, {{signals: [plant.x], every: 0.1 s}}",
)

# -- real time ------------------------------------------------------------------------------------
