"""Messages of refinement studies."""

from cosim.base.messages import Template

# Logs of a study
ALL_LOGS_SEALED = Template("E-REF-001", "every log is sealed, and none is left to learn from; move one to estimation")
NO_LOG = Template("E-REF-002", "no log is listed; list one")
MISSING_LOG = Template("E-REF-003", "{log}: no such file beside the study; its logs are named from there")
LOG_TWICE = Template("E-REF-004", "{log} is listed for {purpose} twice; keep one")
LOG_IN_BOTH_LISTS = Template("E-REF-005", "{log} is listed for {purpose} too; a validation log is never fitted on")
COPY = Template("E-REF-006", "{log} holds the same as {other}, which is listed for {purpose}; keep one")
COPY_IN_OTHER_LIST = Template(
    "E-REF-007",
    "{log} holds the same as {other}, which is listed for {purpose}; a validation log is never fitted on",
)
LOG_TOO_SHORT = Template(
    "E-REF-008",
    "lasts {duration} s, too short to be judged: it takes {least} s, and {better} s and more tell more; "
    "log longer or leave it out",
)
PIECES_TOO_SHORT = Template(
    "E-REF-009",
    "lasts at most {duration} s without a pause, too short to be judged: it takes {least} s, and {better} s and more "
    "tell more; log longer or leave it out",
)
LATENCY_TOO_LONG = Template(
    "E-REF-011",
    "{sensor} is {latency} s, and {logs}: the rest is too short to judge a model; correct this value, or record "
    "longer logs",
)
DIVERGING_MODEL = Template(
    "E-REF-012",
    "{model} runs away on this log: its prediction is not finite at t = {time:.6g} s; check its parameters, start "
    "values and the units of the log, or state a shorter substep in its class",
)

# Keys of a study
INVALID_SETTING = Template("E-REF-013", "{reason}; give a value as in a study file")
IMPLAUSIBLE_NOISE = Template(
    "E-REF-014", "noise.{output}: {level} is no noise of readings of up to {largest}; state it in their unit"
)
UNKNOWN_OUTPUT = Template("E-REF-015", 'no output "{name}"{hint}')
UNKNOWN_STATE = Template("E-REF-049", 'no state "{name}"{hint}')
UNKNOWN_BASE_PARAMETER = Template("E-REF-016", 'no base parameter "{name}"{hint}')
UNKNOWN_INPUT = Template("E-REF-017", 'no input "{name}"{hint}')
UNKNOWN_CANDIDATE = Template("E-REF-018", 'no candidate "{name}"{hint}')
NO_CANDIDATES = Template("E-REF-019", "names none; name some, or leave the key out to try all")

# Parameters per log and groups
GROUPS_WITHOUT_PARAMETERS = Template(
    "E-REF-020",
    "groups, but no parameter per log; say with per_log which parameters differ between them, or leave the groups out",
)
NO_PARAMETERS_PER_LOG = Template("E-REF-022", "names none; name some, or leave the key out")
INACTIVE_PARAMETER = Template(
    "E-REF-023",
    "{name} acts nowhere in the model; an effect that the model lacks is a candidate, so leave {effect} out",
)
UNKNOWN_PARAMETER = Template("E-REF-024", 'no parameter "{name}" of the model or of its sensors{hint}')
PARAMETER_TWICE = Template("E-REF-025", "{name} stands there twice; keep one")
LOG_WITHOUT_VALUE = Template(
    "E-REF-026",
    "{name} needs a value for {log}, which no log of estimation gives, and the filter cannot estimate it during a "
    "run; put {log} in a group with a log of estimation",
)
CANDIDATE_PER_LOG = Template(
    "E-REF-027", "{name} is per log too; one per log is free in every hypothesis; name it in one place"
)
GROUP_NAMED_AS_LOG = Template("E-REF-028", 'a group with the name of the log "{group}"; call it otherwise')
EMPTY_GROUP = Template("E-REF-029", "{group} holds no log; name some, or leave it out")
UNLISTED_LOG = Template("E-REF-030", "{log} is not listed under logs{hint}")
LOG_TWICE_IN_GROUP = Template("E-REF-031", "{log} stands twice; a log has one group, keep one")
LOG_IN_TWO_GROUPS = Template("E-REF-032", "{log} stands in {group} too; a log has one group, keep one")

# Results in Python
NO_PANDAS = Template("E-REF-033", "to_pandas needs pandas: pip install pandas")
NO_ERRORS = Template("E-REF-034", 'no errors of "{part}" are in refine.json; it holds estimation and validation')

# Warnings
READINGS_LEFT_OUT = Template(
    "W-REF-035",
    "{log}: {readings} of {output} left out as outlying, far from the neighbouring readings and from the model",
)
SHORT_PIECES = Template("W-REF-036", "{log}: {pieces} between pauses too short to be used")
LIKELIER_INTERPOLATION = Template(
    "W-REF-037",
    "between rows {inputs}; the other way raises the log-likelihood of the logs by {gain}, {steadiness} times its "
    "scatter: if the rig commands its inputs that way, write {line} in the study",
)
NATIVE_FMU_UNUSED = Template(
    "W-REF-038", "the native FMU of the model is not used: {reason}; every error is that of FMUs in Python"
)
LATE_INPUT = Template(
    "W-REF-066",
    "{name} taken {rows} earlier than recorded raises the log-likelihood of the logs by {gain}, {steadiness} times its "
    "scatter: its column may lag, as behind a filter or a sensor of its own, which no candidate describes; log the "
    "input before the filter, or move its column {time} s earlier and refine again",
)
SHORTER_HORIZON = Template(
    "W-REF-040",
    "errors of the start state grow exponentially in these logs. Predictions therefore last {new} s, in which these "
    "errors grow tenfold, and not the model's {old}",
)
FLOOR_ABOVE_ERROR = Template(
    "W-REF-039",
    "on the {logs} logs the error is below its noise floor ({pairs}). These logs hold less noise and disturbance than "
    "was estimated, so the floor does not apply to them",
)

# Studies of FMUs
NO_SUCH_FMU = Template("E-REF-041", "{name}: no such file; model names the FMU, relative to the study")
TERMS_WITHOUT_FMU = Template(
    "E-REF-042", "terms are for an FMU, and {model} is none; a model lists its effects in its catalogue"
)
FAILED_EVALUATIONS = Template(
    "W-REF-043",
    "the FMU failed in {evaluations}, which count as diverged; the first time: {reason}",
)

# Outlook of `cosim check` on a study of an FMU
WILL_USE = Template("N-REF-050", "`cosim refine` will use {way}")
WILL_TRY = Template("N-REF-051", "`cosim refine` will try {count} terms and parameters: {places}")
STILL_INPUTS = Template("W-REF-053", "not visible: terms at {names}, which never changes in the estimation logs")
UNLOGGED_OUTPUTS = Template("W-REF-054", "not visible: errors of the sensors of {names}, which no estimation log has")
IDLE_PARAMETERS = Template("N-REF-055", "not visible: {names}, which changes no output along these logs")
NO_PORT = Template(
    "W-REF-056",
    "not visible: forces at {names}, because no input acts there and co-simulation gives no access to derivatives",
)
FEW_LOGS = Template(
    "W-REF-057", "co-simulation has free runs only, so at least {least} estimation logs are needed to judge a claim"
)
ONE_WAY = Template(
    "W-REF-058", "not visible: dry friction at {names} apart from a constant force, because the velocity never reverses"
)
NOTHING_SEALED = Template(
    "N-REF-059", "no validation log: a claim from {logs} will not be proven on data that no decision has used"
)
NOT_PROBED = Template(
    "W-REF-060", "{model} is not loaded (--no-load), so the names of candidates, noise and tolerance are not checked"
)
OUT_OF_TIME = Template(
    "E-REF-061",
    "the limit of {limit:g} s (limits: total) is reached at {stage!r}; nothing is written: allow more time, or name "
    "fewer candidates",
)
OWN_STEP_ABOVE = Template(
    "E-REF-062",
    "{name} has no usable model exchange ({reason}), and its co-simulation takes steps of its own of about {own:.3g} s,"
    " above the {step:.3g} s of the logs, so its results are wrong there; export it for model exchange or with a "
    "shorter step, or record rows every {own:.3g} s",
)
MISSING_PLATFORMS = Template(
    "W-REF-063",
    "the delivered FMU lacks the platforms {names} of the original: the library around it cannot be compiled for them "
    "here; pip install 'fmu-cosim[native]' has a compiler for most",
)
REPEATED_MOTION = Template(
    "W-REF-065",
    "{sealed} repeats the motion of {log}: their outputs differ by {share} of their spread, so that it shows how the "
    "refined model predicts this motion again, not how it predicts another one",
)
