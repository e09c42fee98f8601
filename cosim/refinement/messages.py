"""Messages of refinement studies."""

from cosim.base.messages import Template

# Logs of a study
ALL_LOGS_SEALED = Template("E-REF-001", "every log is sealed, and none is left to learn from; move one to estimation")
NO_LOG = Template("E-REF-002", "no log is listed; list one")
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

# Keys of a study
UNKNOWN_OUTPUT = Template("E-REF-015", 'no output "{name}"{hint}')
UNKNOWN_STATE = Template("E-REF-049", 'no state "{name}"{hint}')
UNKNOWN_BASE_PARAMETER = Template("E-REF-016", 'no base parameter "{name}"{hint}')
UNKNOWN_INPUT = Template("E-REF-017", 'no input "{name}"{hint}')
UNKNOWN_CANDIDATE = Template("E-REF-018", 'no candidate "{name}"{hint}')

# Parameters per log and groups
LOG_TWICE_IN_GROUP = Template("E-REF-031", "{log} stands twice; a log has one group, keep one")
LOG_IN_TWO_GROUPS = Template("E-REF-032", "{log} stands in {group} too; a log has one group, keep one")

# Results in Python

# Warnings

# Studies of FMUs

# Outlook of `cosim check` on a study of an FMU
STILL_INPUTS = Template("W-REF-053", "not visible: terms at {names}, which never changes in the estimation logs")
UNLOGGED_OUTPUTS = Template("W-REF-054", "not visible: errors of the sensors of {names}, which no estimation log has")
IDLE_PARAMETERS = Template("N-REF-055", "not visible: {names}, which changes no output along these logs")
NO_PORT = Template(
    "W-REF-056",
    "not visible: forces at {names}, because no input acts there and co-simulation gives no access to derivatives",
)
ONE_WAY = Template(
    "W-REF-058", "not visible: dry friction at {names} apart from a constant force, because the velocity never reverses"
)
OWN_STEP_ABOVE = Template(
    "E-REF-062",
    "{name} has no usable model exchange ({reason}), and its co-simulation takes steps of its own of about {own:.3g} s,"
    " above the {step:.3g} s of the logs, so its results are wrong there; export it for model exchange or with a "
    "shorter step, or record rows every {own:.3g} s",
)
