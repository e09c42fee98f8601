"""Messages of first scenarios, single FMUs, diagrams and exported SSPs."""

from cosim.base.messages import Template

# `cosim simulate`
SCENARIO_EDITED = Template(
    "E-AUT-001", "is a scenario of yours and would be written over; give another folder as --out"
)
STOP_BEFORE_START = Template("E-AUT-002", "ends at {stop:g} s, the run begins at {start:g} s; give a later --stop")
NO_INPUT_IN_RECORDING = Template(
    "E-AUT-003",
    "no column is an input of {fmu} (its columns: {columns}; inputs of {component}: {inputs}); rename a column",
)
INPUT_SET_AND_PLAYED = Template(
    "E-AUT-004", "--set {name}={value}: {recording} plays it; leave out --set, or the column"
)
STEP_TOO_LONG = Template(
    "E-AUT-005",
    "--step {step:g}: is longer than the run, {duration:g} s ({reason}); give a shorter one, or a later --stop",
)
STOP_NOT_FINITE = Template("E-AUT-006", "--stop {value:g}: give a number of seconds")
STEP_NOT_POSITIVE = Template("E-AUT-007", "--step {value:g}: give a number of seconds above 0")
NOT_NAME_VALUE = Template("E-AUT-008", '--set "{text}" is not NAME=VALUE; for example --set mass=2')
RUN_STARTS_LATER = Template(
    "N-AUT-009", "{recording}: begins at {recorded:g} s, the run at {start:g} s as {component} says"
)
RUN_STARTS_WITH_RECORDING = Template("N-AUT-010", "the run begins at {start:g} s, where {recording} does")
RECORDING_ENDS_EARLIER = Template(
    "N-AUT-011", "{recording}: ends at {recorded:g} s; its last row is held until {stop:g} s"
)
UNUSED_COLUMNS = Template("N-AUT-012", "{recording}: {component} has no inputs {columns}: they drive nothing")
STOP_MOVED = Template(
    "N-AUT-013",
    "the run ends at {end:g} s, not at {requested:g} s ({why_end}): in whole steps of {step:g} s ({why_step})",
)
STEP_SHORTENED = Template("N-AUT-014", "the step is {step:g} s, not {requested:g} s ({why_step}), to end at {end:g} s")

# `cosim init`
FILE_IS_A_FOLDER = Template("E-AUT-015", "is a folder; name the file to write as --out")
FILE_EXISTS = Template(
    "E-AUT-016", "is there already; it is never written over; give another name as --out, or move it away"
)
FILE_NOT_YAML = Template("E-AUT-017", "a scenario is YAML; name a .yaml or .yml file as --out")
NO_FOLDER = Template("E-AUT-018", "no such folder; make it first")
NO_PORTS = Template("E-AUT-019", "{fmus} cannot be connected: they have no {ports}; run each alone by `cosim simulate`")
NO_FIT = Template(
    "E-AUT-020",
    "{fmus} cannot be connected: no output ({outputs}) fits an input of another ({inputs}) by type and unit",
)
NO_FIT_OF_ARRAYS = Template(
    "E-AUT-021",
    "{fmus} cannot be connected: no output ({outputs}) fits an input of another ({inputs}) by type, unit and number of "
    "elements; a scenario may connect elements of an array one by one, as {element}",
)
OTHER_PLATFORM = Template("W-AUT-022", "{component} does not run on this machine: {reason}")

# `cosim graph`
NOT_A_DIAGRAM = Template(
    "E-AUT-023", "is there, and no picture of {name}; name another file as --out, or write over it by --force"
)

# `cosim export-ssp`
WRONG_SUFFIX = Template("E-AUT-024", "an SSP is known by its ending; name it so: {name}")
FILE_IS_AN_INPUT = Template("E-AUT-025", "is read, and would be written over; give another file as --out")
KEY_NOT_IN_SSP = Template(
    "E-AUT-026", "{key} cannot be exported, as SSP has no place for them; remove them, or add --set {key}=[]"
)
FIX_NOT_IN_SSP = Template(
    "E-AUT-027", "fixes cannot be exported, as SSP has no place for them; connect the signals without this block"
)
OWN_STEP = Template(
    "E-AUT-028",
    "a communication step of its own: an SSP has one; give the scenario step {step:g}, or leave it out here",
)
FMI_3 = Template("E-AUT-029", "is FMI 3.0; SSP 1.0 and its importers take FMI 1.0 and 2.0")
MODEL_EXCHANGE = Template("E-AUT-030", "is run by model exchange; the importers of SSPs run co-simulation")
ARRAY_CONNECTION = Template("E-AUT-031", "arrays are not what SSP 1.0 can connect; connect their elements")
TYPE_NOT_CONNECTED = Template("E-AUT-032", "{signal} is {type}; importers connect {types}")
TYPE_MISMATCH = Template(
    "E-AUT-033",
    "{source} is {source_type}, {target} {target_type}: importers of SSPs convert no types; give both one type",
)
CONVERTING_CONNECTION = Template(
    "E-AUT-034",
    "the connection converts: {source} [{source_unit}] to {target} [{target_unit}]; not all importers of SSPs convert; "
    "let both ends have one unit, or an FMU between them convert",
)
NOT_COMPILED = Template("E-AUT-035", "becomes an FMU of C, which cannot be compiled: {error}")
NOISE_OMITTED = Template("N-AUT-036", "noise is left out: SSP has no word for it")
TOLERANCE_OMITTED = Template(
    "N-AUT-037", "tolerance is left out: importers take that of each FMU's default experiment, or none"
)
CRITERIA_OMITTED = Template("N-AUT-038", "criteria are left out: SSP has no word for them")
OTHER_ALGORITHM = Template(
    "N-AUT-039",
    "libcosim, ecos and FMPy step by {theirs}, this scenario by {ours}, so their results may differ; compare "
    "theirs with `cosim run --set algorithm={algorithm} --set noise=off`",
)
