"""Messages of replays."""

from cosim.base.messages import Template

UNKNOWN_SIGNAL = Template("E-RES-002", 'has no {kind} "{name}", which {log} holds{cure} (its {kind}s: {names})')
OTHER_UNIT = Template(
    "E-RES-003", "{name} is in {unit} here and in {other} in the log as it was read; read the log for this FMU"
)
UNKNOWN_PARAMETER = Template("E-RES-004", 'has no parameter "{name}"{cure}')
START_OPTION = Template("E-RES-005", '--start "{text}": {reason}')
FULL_DISK = Template("E-RES-006", "the disk is full: {count} of {rows} rows are in {file}")
FULL_DISK_AFTER_RUN = Template("E-RES-007", "the disk is full: all {rows} rows are in {file}, there is {missing}")
OLD_FMU = Template(
    "W-RES-008",
    "{fmu} was built by an earlier version, which says nothing of frame, limits and state: "
    "the log is checked less and windows start worse; build it again",
)
HIDDEN_STATE = Template(
    "W-RES-009",
    "is missed by {error} over {horizon}\u00a0s where the FMU is restarted from its own outputs: "
    "it keeps a state that no output shows, and only the free run measures it",
)
SENSOR_ERRORS = Template(
    "W-RES-010",
    "the readings have {names}, which the refine beside {fmu} claims and an FMU does not hold; correct the readings, "
    "or see error.after in its refine.json",
)
