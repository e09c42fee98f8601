"""Messages of runs."""

from cosim.base.messages import Template

FILE_OF_ANOTHER_RUN = Template(
    "E-SIM-001",
    "{path} is not the {kind} of this run: its SHA-256 differs; put that one back, or run the scenario",
)
NO_FMU_IN_SSP = Template("E-SIM-002", "it has no FMU, so there is nothing to run")
NO_RESULTS = Template("E-SIM-003", "no such folder or file; give {kind}")
NO_ROWS = Template("E-SIM-004", "holds no rows ({names}); give {kind}")
NO_FMU = Template("E-SIM-005", "no such file; give an FMU")
FAILED_TRIAL = Template("E-SIM-006", "does not run: {error}{cure}")
NO_SPACE_FOR_TRIAL = Template("E-SIM-007", "cannot be tried: {error}; --no-load checks it without")
UNKNOWN_SIGNAL = Template("E-SIM-008", 'no signal "{name}"{hint}')
NO_PANDAS = Template("E-SIM-009", "to_pandas needs pandas: pip install pandas")
DISK_FULL = Template("E-SIM-010", "the disk is full: {count} of {rows} rows are in {file}{missing}{before}")
FMI_RULE = Template("W-SIM-011", "{problem}")
DESIGN_NOT_CHECKED = Template("W-SIM-012", "{reason} (--no-load); the design is not checked")
NO_STOP_TIME = Template("W-SIM-013", "the SSP names no stopTime: {time:g} s are run; --set duration=… for others")
NO_STEP = Template("W-SIM-014", "the SSP names no communication step: {step:g} s is taken; --set step=… for another")
LONGER_DURATION = Template(
    "W-SIM-015", "{time:g} s are run, the next whole number of steps of {step:g} s after stopTime"
)
LIMITS_NOT_WATCHED = Template("W-SIM-016", "limits are not watched where FMUs run in this process")
COUPLING_ERROR_UNKNOWN = Template("W-SIM-017", "coupling error not known: with half the step {reason}")
COUPLING_ERROR = Template("N-SIM-018", "half the step changes at most {changes}{steps}")
CHANGED_WHILE_RUNNING = Template(
    "N-SIM-019", "{count} made while it ran; the manifest holds them as events, so that it repeats the run"
)
