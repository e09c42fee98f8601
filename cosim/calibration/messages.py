"""Messages of fits."""

from cosim.base.messages import Template

# -- what is varied -------------------------------------------------------------------------------

NOT_VARIED = Template("E-CAL-001", '--vary "{text}" is none of NAME, NAME=20% and NAME=LOW..HIGH, as in mass=0.3..2')
UNKNOWN_VARIABLE = Template("E-CAL-002", 'the FMU has no variable "{name}"{cure}')
NOT_ESTIMABLE = Template(
    "E-CAL-003",
    "{name} is {kind}, which has no value to estimate; name a parameter, or the start value of a state ({names})",
)
WRONG_VALUE = Template("E-CAL-004", "{name}: {text} is not allowed: {reason}")
REPEATED_NAME = Template("E-CAL-005", "{name} is named twice; name it once")
EMPTY_RANGE = Template("E-CAL-006", "{name}: {low:g} is not below {high:g}; give LOW..HIGH with LOW below HIGH")
START_OUTSIDE = Template(
    "E-CAL-007", "{name} starts at {value:g}, outside {low:g} to {high:g}; give another value as --start {name}=VALUE"
)
NO_PARAMETERS = Template(
    "E-CAL-008", "has no parameter to estimate: no floating-point parameter with a start value may be set before a run"
)
TOLERANCE_OF_ZERO = Template("E-CAL-009", "{name} starts at 0, of which {text} is nothing; give a range LOW..HIGH")
WRONG_TOLERANCE = Template("E-CAL-010", "{name}: {text} is no tolerance; give a percentage above 0, such as 20%")
NOTHING_IDENTIFIABLE = Template(
    "E-CAL-011",
    "no parameter is identifiable from these logs: {reasons}; name parameters as --vary, or log other inputs",
)

# -- logs -----------------------------------------------------------------------------------------

NO_LOGS = Template("E-CAL-012", "names no log to estimate from; name at least one")
USED_TWICE = Template("E-CAL-013", "is named twice; a log is used once, for the estimate or as a sealed log")
TOO_FEW_VALUES = Template(
    "E-CAL-014", "{rows} measured values cannot determine {count} unknowns; name fewer parameters or more logs"
)

# -- the estimate ---------------------------------------------------------------------------------

STOPPED_AT_LIMIT = Template(
    "E-CAL-015",
    "the limit of {limit:g} s (limits: total) is reached; the best values so far are written, without proof",
)
AT_BOUND = Template(
    "W-CAL-016", "{name} ends at its bound {value}: its interval ignores the bound, and the bound may be wrong"
)
HELD = Template("W-CAL-017", "{sentence}; {held} is held at {value}, and none of them has an interval")
NOT_CONVERGED = Template(
    "W-CAL-018", "the estimate did not settle: the likelihood is rough, and the intervals are unsure"
)
FAILED_RUNS = Template(
    "W-CAL-019", "{count} of {runs} simulations failed and were rejected, first at {values}: {reason}"
)
ABOVE_NOISE = Template(
    "W-CAL-020",
    "the error of {names} stays above the noise and is not white: no value of these parameters explains it. "
    "`cosim refine` looks for what the FMU lacks, with a study of the same logs",
)
NO_COPY = Template(
    "W-CAL-021",
    "no fitted.fmu: {reason}. fitted.ssv has the values; `{command}` sets them",
)
UNCERTAIN = Template(
    "W-CAL-022", "{name} is barely determined by these logs: its 95 % interval is wider than its value before the fit"
)
WINDOWS_USED = Template("N-CAL-023", "the estimate uses windows of {horizon:g} s in place of free runs: {reason}")
DROPPED_STARTS = Template("W-CAL-024", "windows have start values of their own, so {names} is not estimated")
RISEN = Template("W-CAL-025", "on sealed logs the error of {names} rises by more than its scatter from part to part")

# -- reasons --------------------------------------------------------------------------------------

IGNORES_XML = Template(
    "N-CAL-026",
    "the library ignores the start values of modelDescription.xml, so a changed copy would still start as before",
)
UNREADABLE_XML = Template("N-CAL-027", "the start value of {name} was not found in modelDescription.xml")
NO_PANDAS = Template("E-CAL-028", "to_pandas() needs pandas: pip install pandas")
IDLE = Template("W-CAL-029", "no effect on any measured output of these logs, so the value is kept: {names}")

# -- studies --------------------------------------------------------------------------------------

NO_FMU_IN_STUDY = Template(
    "E-CAL-030", "{model} is no FMU, and `cosim fit` needs one; `cosim refine` estimates the parameters of a model file"
)
MISSING_FILE = Template("E-CAL-031", "{file} does not exist; file names are relative to the study")
UNUSED_KEYS = Template("W-CAL-032", "`cosim fit` does not use {keys}: `cosim refine` does")
BESIDE_STUDY = Template(
    "E-CAL-033",
    "is {kind}, which names its FMU, logs and columns; `cosim fit` takes it without --fmu, --sealed and --column",
)
NO_FMU = Template("E-CAL-034", "no FMU is named; add --fmu X.fmu, or give a study file alone")
WILL_ESTIMATE = Template("N-CAL-035", "`cosim fit` will estimate {names}")
WILL_SCREEN = Template("N-CAL-036", "`cosim fit` will estimate what the logs determine of {names}")
OWN_STEP_ABOVE = Template(
    "E-CAL-037",
    "its co-simulation takes steps of its own of about {own:.3g} s, above the {step:.3g} s of the logs, so its results "
    "are wrong there; export it with a shorter step, or record rows every {own:.3g} s",
)
