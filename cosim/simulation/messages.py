"""Messages of runs."""

from cosim.base.messages import Template

ERROR_OF_CONTROLLED_STEPS = Template(
    "E-SIM-021", "controls the error of each step; --coupling-error measures equal steps: set one, --set step=0.01"
)

FILE_OF_ANOTHER_RUN = Template(
    "E-SIM-001",
    "{path} is not the {kind} of this run: its SHA-256 differs; put that one back, or run the scenario",
)
NO_FMU_IN_SSP = Template("E-SIM-002", "it has no FMU, so there is nothing to run")
NO_RESULTS = Template("E-SIM-003", "no such folder or file; give {kind}")
NO_ROWS = Template("E-SIM-004", "holds no rows{status}: no {names}; give {kind}")
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
NO_RUN_FOLDER = Template(
    "E-SIM-074", "not the folder of a run; --resume and --until take the folder of an earlier run, as results/NAME"
)
NOTHING_TO_RESUME = Template(
    "E-SIM-060",
    "no run is in it that could go on; `cosim run SCENARIO` begins one, `checkpoint: 60 s` keeps checkpoints",
)
ALREADY_FINISHED = Template(
    "E-SIM-061", "its run is finished, at t = {time:g} s; --until T with a later time T extends it"
)
END_NOT_LATER = Template("E-SIM-062", "--until {end:g} s is not after t = {time:g} s, which the run has reached")
END_BETWEEN_STEPS = Template(
    "E-SIM-078", "--until {end:.12g} s is between two communication points, {step:g} s apart; give {ends}"
)
OTHER_VERSION = Template(
    "E-SIM-063",
    "its run is of cosim {version}, and this is {own}: the same bytes cannot be promised; go on with that version, or "
    "run the scenario again from its start",
)
DAMAGED_CHECKPOINT = Template("E-SIM-064", "the checkpoint is damaged: {reason}; run the scenario again from its start")
ROWS_OF_ANOTHER_RUN = Template(
    "E-SIM-065",
    "its rows are not those of the checkpoint: a file was changed or removed; put it back, or run the scenario again "
    "from its start",
)
STOPPED_BEFORE_ROWS = Template(
    "E-SIM-066", "its run was stopped before its first row or checkpoint; run the scenario again from its start"
)
WORKER_STILL_ENDS = Template("E-SIM-067", "a process of the killed run still writes into it; try again in a moment")
RESUME_WITH_OPTION = Template(
    "E-SIM-068", "a run goes on as it began, so --resume and --until take no {option}; leave it out"
)
NO_CHECKPOINT_IN_PROCESS = Template("W-SIM-069", "no checkpoints are made where FMUs run in this process")
BEGINS_AGAIN = Template(
    "N-SIM-076",
    "record leaves out signals or rows, so the run is made again from t = {time:g} s; checkpoint: keeps all of them",
)
MANY_ROWS = Template(
    "N-SIM-077", "the run has {rows} rows; --format parquet writes, reads and stores so many much faster than CSV"
)
GOES_ON = Template("N-SIM-070", "the run goes on from t = {time:g} s, row {row} of {rows}{replay}")
REPLAY_ON_RESUME = Template(
    "N-SIM-071",
    "no checkpoint has the state of {names}: a resumed run makes all steps again from the start, which takes as long "
    "as they took",
)
STATE_ENDS = Template(
    "N-SIM-088",
    "{names}: the saved state does not go beyond t = {time:g} s, the end that the FMU was told; so all steps are "
    "made again",
)
FINISHED_RUN_KEPT = Template("N-SIM-089", "the longer run failed; the finished run in {folder} is as it was{rows}")
ROWS_ARE_WRITTEN = Template("N-SIM-091", "the steps have ended; their {rows} rows are being written to {file}{end}")
NEXT_STOP = Template("N-SIM-092", "; Ctrl-C now ends that and keeps the rows written by then")
ROWS_ENDED = Template("E-SIM-093", "{reason}only {count} of {rows} rows are in {file}, as the writing was stopped")
NO_REPORT = Template("W-SIM-094", "there is no report: {reason}; `cosim report {folder}` makes it")
ROWS_NOT_COMPLETE = Template("E-SIM-095", "its rows are not all written: it was killed meanwhile, or still writes them")
ROWS_OF_KILLED_RUN = Template(
    "N-SIM-096",
    "{folder}: a run was killed while it wrote its rows; those written ({size:.3g} MB) are kept, and `cosim list` "
    "names them",
)
DRAFT_OF_KILLED_RUN = Template(
    "N-SIM-097",
    "{file}: a run was killed while it wrote its rows; those written ({size:.3g} MB) cannot be read without the end of "
    "the file, and are removed; rows in CSV are kept",
)
NO_ROOM_BESIDE_EARLIER = Template(
    "W-SIM-098",
    "the disk is too full to move the earlier run in {folder} to runs: it stays, and this run is in {place}",
)
FAILED_ROWS = Template("N-SIM-090", ", and the rows of the longer run are in {folder}")
GETS_SLOWER = Template(
    "W-SIM-075", "{component} takes {factor:.2g} times longer for a step since t = {since:g} s than before"
)
LOOP_LEFT_OPEN = Template(
    "W-SIM-080",
    "{loop} is an algebraic loop that no FMU declares: measured before the run, {facts}. It is left open, so that some "
    "inputs have the values of the step before, because solving it fails: {reason}",
)
FOLLOWS_AT_START = Template(
    "W-SIM-081",
    "{loop} may be an algebraic loop that no FMU declares: in initialization {facts}, later only with a step. "
    "It is left open, so that some inputs may have the values of the step before; {cure}",
)
REPEATED_STEPS = Template("N-SIM-086", "loops: {{}} solves it by repeated steps")
STATED_ORDER = Template(
    "N-SIM-087",
    "an FMU that saves and restores its state, or one without direct feedthrough, would be a cure; order: [...] states "
    "that it is open, without this warning",
)
NOT_MEASURED = Template(
    "W-SIM-083",
    "{loop} may be an algebraic loop: whether outputs follow {inputs} at once is not declared, nor measured{reason}; "
    "cosim assumes that none does; feedthrough: [...] of the component names the inputs that an output follows, [] for "
    "none; loops: {{}} solves it; order: [...] states the order instead",
)
MEASURING = Template(
    "N-SIM-084",
    "measuring which outputs of {components} follow their inputs at once, which these FMUs do not declare: at most "
    "{limit:g} s",
)
MEASURED_TOO_LONG = Template("N-SIM-085", "it takes longer than {limit:g} s in all, at last in {component}")
RUN_GETS_SLOWER = Template(
    "W-SIM-082",
    "all components take about {factor:.2g} times longer for a step since t = {since:g} s than before: the machine is "
    "busy with something else",
)
REPLAY_COST = Template(
    "N-SIM-072", "; as the state of {names} is not saved, all steps are made again, which takes about {seconds:.2g} s"
)
