"""Messages of bench and craft identification."""

from cosim.base.messages import Template

PULSE = "such as 7.5 for a pulse of 1500 µs in a frame of 20 ms"

# -- commands of a run ----------------------------------------------------------------------

NO_THRUST_ABOVE = Template(
    "E-IDN-001",
    "duty is {value:g} % at most, and thrust begins above {limit:.2f} %: the phase with thrust is missing; {cure}",
)
NO_THRUST = Template("E-IDN-002", "duty is {value:g} % at most: the phase with thrust is missing; {cure}")
DUTY_OF_ONE = Template(
    "E-IDN-003", "duty is {value:g} % at most, as of a share of one, duty [1]: the phase with thrust is missing; {cure}"
)
NO_REST = Template("E-IDN-004", "the phase at rest is missing: duty is {value:g} % there already; {cure}")
TOO_FEW_ROWS_IN_WINDOW = Template(
    "E-IDN-005",
    "rows are {step:g} s apart, so that `{window}` from {start:g} to {end:g} s holds {count}, {least} at least; {cure}",
)
NO_PHASE_IN_WINDOW = Template(
    "E-IDN-006",
    "the phase `{window}` from {start:g} to {end:g} s is missing, it lasts from {first:.10g} to {last:.10g} s; {cure}",
)
CLOCK_WITHOUT_WINDOW = Template(
    "E-IDN-007",
    "the phase `{window}` from {start:g} to {end:g} s is missing, it lasts from {first:.10g} to {last:.10g} s, a clock "
    "that does not begin at 0 s; {cure}",
)
DUTY_WITHOUT_THRUST = Template(
    "E-IDN-008", "duty is {value:.4g} % {where}, where thrust begins above {limit:.4g} %; {cure}"
)
NOT_UPRIGHT = Template(
    "E-IDN-009", "the tilt is up to {value:.1f}° {where}, which is read upright ({limit:g}° or less); {cure}"
)
UNSTEADY_DUTY = Template(
    "E-IDN-010",
    "the duty goes from {low:.4g} to {high:.4g} % {where}, or in the {time:.2g} s before, in which thrust and low pass "
    "settle; {cure}",
)
NO_SWEEP = Template("E-IDN-011", "the tilt does not vary in the window: the sweep of servo_duty is missing; {cure}")
NO_RAMP = Template("E-IDN-012", "the duty does not vary from {start:g} to {end:g} s: the ramp is missing; {cure}")
LOW_RAMP = Template(
    "E-IDN-013",
    "of the ramp from {start:g} to {end:g} s less than {least:g} % is above {limit:.2f} %, where thrust begins; {cure}",
)
JUMP_BEFORE_RAMP = Template(
    "E-IDN-014",
    "the duty jumps at {time:.4g} s, and `window` begins at {start:g} s, before thrust and low pass have settled; "
    "{cure}",
)
OTHER_DUTY_OF_HOLD = Template(
    "E-IDN-015",
    "duty is {hold:.4g} % in `hold` and {window:.4g} % in `window`: forces are relative to the thrust of `hold`; "
    "{cure}",
)
SMALL_STEP = Template("E-IDN-016", "{command} steps by {size} at {time:g} s, less than {least}; {cure}")
NO_STEP = Template("E-IDN-017", "{command} has no step at {time:g} s; {cure}")
STEP_OUTSIDE_WINDOW = Template(
    "E-IDN-018", "`window` from {start:g} to {end:g} s does not hold the step `at` {time:g} s; {cure}"
)
TOO_FEW_ROWS_ABOUT_STEP = Template(
    "E-IDN-019",
    "`window` has {after} rows after the step at {time:g} s, and {before} are before it; {least_after} after it and "
    "{least_before} before it are needed; {cure}",
)
UPRIGHT_END = Template(
    "E-IDN-020", "the step ends at {angle:.1f}°, upright, where a tilt has no horizontal force; {cure}"
)
TWO_STEPS = Template(
    "E-IDN-021", "{other} changes too about the step of {command}, from {start:.4g} to {end:g} s; {cure}"
)
NO_SINE = Template("E-IDN-022", "there is no sine of servo_duty after {time:g} s; {cure}")
SINE_AT_SEVERAL_DUTIES = Template("E-IDN-023", "the duty goes from {low:.4g} to {high:.4g} % under the sine; {cure}")
SHORT_SINE = Template(
    "E-IDN-024",
    "the sine of {frequency:g} rad/s ends at {time:.4g} s, before a whole period after what is skipped; {cure}",
)
TOO_FEW_ROWS_IN_PERIOD = Template(
    "E-IDN-025", "rows are {step:.4g} s apart, fewer than {least} in a period of {frequency:g} rad/s; {cure}"
)
OTHER_FREQUENCY = Template(
    "E-IDN-026", "the sine of servo_duty is {fitted:.3g} rad/s, and the protocol has {frequency:g} rad/s; {cure}"
)
MOTOR_ON = Template("E-IDN-027", "duty is {value:g} % in `window`: the moment is read with the motor off; {cure}")

# Cures for a planned run and for a recording; `place` is that of the test in its protocol.
INTERPOLATED_COMMAND = Template(
    "E-IDN-159",
    "only one row in {rows} of servo_duty is a command, the others lie on straight lines between commands: a servo "
    "holds its command, and the lines move it by {time:.2g} s; {cure}",
)
RUN_CURES = {
    NO_THRUST_ABOVE: ("add it", "record it"),
    NO_THRUST: ("add it", "write the duty in %, or record it"),
    DUTY_OF_ONE: ("add it", "write the duty in %, or record it"),
    NO_REST: (
        "rest before the duty rises above {rest:g} %, for the tare",
        "begin each run with the motor off, for the tare",
    ),
    TOO_FEW_ROWS_IN_WINDOW: (
        "lengthen it, or lower `step` below {step:g}",
        "if the time is in milliseconds, name its column time [ms]; else record faster",
    ),
    NO_PHASE_IN_WINDOW: ("move it or add a phase", "record it, or change {place}.{window}"),
    CLOCK_WITHOUT_WINDOW: ("move it or add a phase", "record it, or change {place}.{window}"),
    DUTY_WITHOUT_THRUST: ("move it to where there is thrust", "record it under thrust"),
    NOT_UPRIGHT: ("move it to where it is upright", "record it upright"),
    UNSTEADY_DUTY: ("move it to where the duty stands", "record it at one duty"),
    NO_SWEEP: ("move the window to it", "record it"),
    NO_RAMP: ("move the window to it", "record it"),
    LOW_RAMP: ("move the window, or let the ramp go higher", "record a ramp that goes higher"),
    JUMP_BEFORE_RAMP: (
        "let it begin {settling:.2g} s after the jump, at {begin:.4g} s",
        "let it begin {settling:.2g} s after the jump, at {begin:.4g} s: change {place}.window",
    ),
    OTHER_DUTY_OF_HOLD: ("have both at one duty", "record both at one duty"),
    SMALL_STEP: ("let it step by {least} at least", "let it step by {least} at least"),
    NO_STEP: ("phases of two values at one time make a step; {steps}", "say when it is in {place}.at"),
    STEP_OUTSIDE_WINDOW: (
        "let it begin with the step, and end when its answer has settled",
        "change {place}.window, or {place}.at",
    ),
    TOO_FEW_ROWS_ABOUT_STEP: ("move its end, or the step", "change {place}.window"),
    UPRIGHT_END: ("let it end tilted", "record a step that ends tilted"),
    TWO_STEPS: ("let the other stand from before the step on", "record the step alone"),
    NO_SINE: ("give it 1° at least", "record it, or change {place}.lead"),
    SINE_AT_SEVERAL_DUTIES: ("keep it", "record it at one duty"),
    SHORT_SINE: ("play it until {needed:.4g} s", "record it until {needed:.4g} s"),
    INTERPOLATED_COMMAND: ("", "write each command until the next, as it was sent"),
    TOO_FEW_ROWS_IN_PERIOD: ("", "record it at {limit:.3g} s or less, or leave it out"),
    OTHER_FREQUENCY: ("", "look at the clock of the recording, or change {place}.frequencies"),
    MOTOR_ON: ("keep the duty of `rest`", "record it without thrust"),
}

# -- columns of a recording -----------------------------------------------------------------

VALUE_OUT_OF_RANGE = Template(
    "E-IDN-028", "{column} is {value:.4g} {unit} here, beyond {low:g} to {high:g} {unit} ({meaning}); {cure}"
)
VOLTAGE_OUT_OF_RANGE = Template(
    "E-IDN-029",
    "{column} is {value:.4g} V here, beyond the converter's 0 to {high:g} V; say its unit in the column's name, "
    "{column} [mV], or `converter_range` under `parameters`",
)
NEGATIVE_VOLTAGE = Template(
    "E-IDN-030",
    "{column} is {value:.4g} V here, beyond the converter's 0 to {high:g} V; write raw voltages: the tare is read at "
    "rest and taken off here",
)
VOLTAGE_SPIKE = Template(
    "E-IDN-031",
    "{column} is {value:.4g} V here, beyond the converter's 0 to {high:g} V, at {readings}: a spike; repeat the run, "
    "or replace the reading by the mean of its neighbours",
)
IMPOSSIBLE_TILT = Template(
    "E-IDN-032",
    "servo_duty of {value:.4g} % is a tilt of {angle:.0f}°, beyond ±{limit:.0f}°; write it in % (" + PULSE + "), or "
    "give `servo_neutral` and `servo_slope` of this servo under `parameters`",
)
VARYING_HEIGHT = Template(
    "E-IDN-033",
    "height goes from {low:.4g} to {high:.4g} m in `window`; a run has one height; is another column called height?",
)
OTHER_HEIGHT = Template(
    "E-IDN-034",
    "height is {value:.4g} m, and {limit:g} m in the protocol (tests.{test}.height); name its unit, height [mm], or "
    "correct one of them",
)
LOW_HEIGHT = Template(
    "E-IDN-035",
    "height is {value:.4g} m, below half the propeller's radius ({limit:.4g} m), where eq 4.28 ends; measure it from "
    "the ground to the propeller, or correct `propeller_radius`",
)

# -- load cells -----------------------------------------------------------------------------

LOAD_TURNS_BACK = Template(
    "E-IDN-036", "between {low:.4g} V and {high:.4g} V the load turns back; measure those points again"
)
POINT_BEYOND_CONVERTER = Template(
    "E-IDN-037",
    "a point has {value:g} V, beyond the converter's 0 to {limit:g} V; write volts, or `converter_range` under "
    "`parameters`",
)
TOO_FEW_POINTS_IN_RANGE = Template(
    "E-IDN-038",
    "{count} of {total} points are inside the converter's range and beyond their error of its ends, and {least} are "
    "needed; measure more points inside it",
)

# -- protocols of a bench -------------------------------------------------------------------

NO_TEST = Template("E-IDN-039", "holds no test; add one of {names}")
NO_FMU = Template(
    "E-IDN-040", "no such FMU: {name}; write {bench} for the one that is built here, or the path of yours"
)
UNKNOWN_PARAMETER = Template("E-IDN-041", 'a bench has no "{name}"{hint}')
NO_CELL = Template("E-IDN-042", 'cell "{name}" is missing; a bench has {names}')
UNKNOWN_CELL = Template("E-IDN-043", "no such cell; a bench has {names}")
WRONG_UNIT = Template("E-IDN-044", "{unit} is no unit of {wanted}{hint}")
LOADS_AND_POINTS = Template(
    "E-IDN-045",
    "has both loads and points; give `loads` to hang on the bench that is played, or `points` [load, voltage] as "
    "measured",
)
NO_LOADS = Template(
    "E-IDN-046",
    "has neither loads nor points; give `loads` to hang on the bench that is played, or `points` [load, voltage] as "
    "measured",
)
LOADS_WITHOUT_BENCH = Template("E-IDN-047", "no bench is played; give `points` [load, voltage] as measured")
REPEATED_LOAD = Template("E-IDN-048", "{load:g} is hung twice; hang each load once")
TOO_FEW_LOADS = Template("E-IDN-049", "a curve needs four points at least; measure more")
LOAD_BEYOND_SCALE = Template(
    "E-IDN-050",
    "{load:g} {unit} is beyond the cell's full_scale of {limit:g} {unit}; correct the unit, the load or full_scale",
)
NARROW_LOADS = Template(
    "E-IDN-051",
    "the loads span {span:.3g} {unit}, where the error of each is {error:.3g} {unit} (`error` of `full_scale`); "
    "correct the unit, or hang larger loads",
)
NO_FILES = Template(
    "E-IDN-052",
    "has no files, and no bench is played; name the bench that is to be played as `bench:`, or the recordings as "
    "`files:`",
)
EMPTY_WINDOW = Template("E-IDN-053", "{start:g} … {end:g} s is empty; write its start, then its end")
PERIODS_UNLIKE_FREQUENCIES = Template("E-IDN-054", "{periods} for {frequencies} frequencies; give one each")
TOO_FEW_HEIGHTS = Template("E-IDN-055", "two heights are needed at least; add one")
TOO_FEW_FILES = Template(
    "E-IDN-056", "{recordings}, too few: intervals come from scatter between {least} or more; add recordings"
)
REPEATED_FILE = Template("E-IDN-057", "{name} is named twice; a repetition is a run of its own")
NO_PHASES = Template("E-IDN-058", "has neither phases to play nor files; give either")
TOO_FEW_REPETITIONS = Template(
    "E-IDN-059", "{count} are too few: intervals come from scatter between {least} or more; raise the number"
)
WRONG_TIMES_OF_PHASES = Template("E-IDN-060", "times of phases must increase, up to {limit:g} s; correct them")
WINDOW_AFTER_PHASES = Template("E-IDN-061", "ends at {end:g} s, the phases at {last:g} s; move it or add a phase")
THRUST_AT_START = Template(
    "E-IDN-062",
    "begins with duty {duty:g} %: a phase at rest is missing, so that cells have no tare; begin at {limit:g} % or less",
)

# -- planned runs ---------------------------------------------------------------------------

SHORT_STEP = Template(
    "E-IDN-063",
    "the step is too short: a run of {time:g} s would have {rows:.3g} rows, and {limit} are allowed; give "
    "{least:.1g} s or more",
)
LONG_STEP = Template(
    "E-IDN-064",
    "{step:g} s is too long: {place} and {others} need at least {least} rows each; give {limit:.3g} s or less",
)
REPEATED_HEIGHT = Template(
    "E-IDN-065", "{height:g} is listed twice; list it once, and record more runs at each height to repeat it"
)
HEIGHT_IN_GROUND = Template(
    "E-IDN-066",
    "{height:g} radii is too low: the ground effect of eq 4.28 is valid from {least:g} radii; give that or more",
)
LOW_FREE_HEIGHT = Template(
    "E-IDN-067",
    "{height:g} m is not above the heights near the ground, which reach {limit:.3g} m ({ratio:g} radii of "
    "{radius:g} m); give 10 radii or more, where the ground has no effect",
)
VALIDATION_WITHOUT_THRUST = Template(
    "E-IDN-068", "a duty of {duty:g} % gives no thrust; thrust begins above {limit:.4g} %, give a higher duty"
)
VALIDATION_DUTY_OF_PHASES = Template(
    "E-IDN-069",
    "a duty of {duty:g} % is used by the phases already; give the validation set another duty, or leave it out",
)
REPEATED_FREQUENCY = Template(
    "E-IDN-070",
    "{frequency:g} rad/s is listed twice; list it once, and record more runs at each frequency to repeat it",
)
HIGH_FREQUENCY = Template(
    "E-IDN-071",
    "{frequency:g} rad/s at a step of {step:g} s has less than {least} rows per period; give {limit:.3g} rad/s or "
    "less, or a shorter `step`",
)

# -- model of the power-train ---------------------------------------------------------------

MODEL_WITHOUT_NUMBERS = Template(
    "E-IDN-072",
    "{model} has none of {names}: nothing that is identified is a parameter of it; name the model of what stands on "
    "the bench",
)

# -- recordings -----------------------------------------------------------------------------

NO_UNIT_OF_TIME = Template("E-IDN-073", "{unit} is no unit of time; write time [s] or time [ms]")
NO_UNIT_OF_COLUMN = Template("E-IDN-074", "{unit} is no unit of {column} [{wanted}]; give the column in {wanted}")
TIME_FOR_DUTY = Template("E-IDN-075", "{unit} is no unit of {column} [%]; write it in %, " + PULSE)
DECIMAL_COMMAS = Template(
    "E-IDN-076", "numbers have decimal commas; write decimals with a point, and separate cells with commas"
)
NO_COLUMN = Template("E-IDN-077", 'column "{name}" [{unit}] is missing{hint}; add it')
SHORT_RECORDING = Template("E-IDN-078", "holds {rows}; a run has ten at least; record it anew")
UNEVEN_CLOCK = Template(
    "E-IDN-079",
    "{gap:.3g} s pass before this row, {step:.3g} s before others; rows are missing, or the clock is uneven: resample "
    "to rows {step:.3g} s apart, volts by straight lines, duties held",
)
NO_BENCH = Template("E-IDN-080", 'is no bench: it lacks "{name}"; it has {names}')
DROPOUT = Template(
    "E-IDN-081",
    "volts_{cell} is {value:.4g} V here, and the readings beside it are not (up to {distance:.3g} V off): a dropout; "
    "delete such rows (single missing rows are filled in), or look at the wires and record it anew",
)
DROPOUTS = Template(
    "E-IDN-082",
    "volts_{cell} is {value:.4g} V here, and the readings beside it are not (up to {distance:.3g} V off); so are "
    "{others} of this file: a dropout; delete such rows (single missing rows are filled in), or look at the wires and "
    "record it anew",
)
SHORT_RAMP = Template(
    "E-IDN-083",
    "the ramp has too few readings with thrust within the range of the cell: a line needs {rows} over {least:g} % "
    "of duty; give a window with more of the ramp",
)
RAMP_BEYOND_RANGE = Template(
    "E-IDN-084",
    "the ramp has too little thrust within the cell's range: a line needs {rows} readings over {least:g} % of duty; "
    "let the window hold more of it. The range ends with {value:.3g} V at {duty:.4g} %, {place}",
)
AT_RAIL = Template(
    "E-IDN-085",
    "volts_{cell} is at the end of its range, {value:.3g} V, at {share:.0f} % of the readings, first in this row; "
    "take a cell of a larger range, or less thrust",
)
CONSTANT_VOLTAGE = Template("E-IDN-086", "volts_{cell} stands still at {value:.4g} V; does the bench move it?")
STUCK = Template(
    "E-IDN-087",
    "volts_{cell} stands still at {value:.4g} V from this row on, for {readings}; readings have noise, so look at the "
    "cell and its wires, and record it anew",
)
CLIPPED = Template(
    "E-IDN-088",
    "volts_{cell} is exactly {value:.4g} V, its extreme, at {readings}, first in this row: the cell or its amplifier "
    "is at its end, or stuck; take a larger range or less force, end `window` before, or look at the wires",
)
REPEATED_READINGS = Template(
    "E-IDN-089",
    "volts_{cell} repeats each reading {count:.2g} times, every {time:.2g} s; record at the rate at which the cell is "
    "read, for a time is read off it",
)
COARSE_READINGS = Template(
    "E-IDN-090",
    "volts_{cell} is recorded in steps of {value:.3g} V and moves by {count} of them from rest to `window`; record "
    "more digits, or more gain",
)
THRUST_IN_OTHER_CELL = Template(
    "E-IDN-091",
    "volts_{cell} follows the thrust and volts_z does not, upright: are the channels swapped? Change their names",
)
NEGATIVE_THRUST = Template(
    "E-IDN-092",
    "the vertical force falls with the duty: volts_z is unplugged, or has the wrong sign or another calibration; look "
    "at its plug and at the points of cell z",
)
TILT_IN_MOMENT_CELL = Template(
    "E-IDN-093", "volts_m follows the tilt and volts_x does not: are the channels swapped? Change their names"
)
NO_FORCE = Template(
    "E-IDN-094",
    "neither volts_z nor volts_x has a force at {angle:.0f}°, beyond what a reading scatters; did the motor run? "
    "Record it under thrust",
)
LARGE_HORIZONTAL_FORCE = Template(
    "E-IDN-095",
    "at {angle:.0f}° the force of volts_x is larger than that of volts_z: are the channels swapped? If so, swap "
    "the names of their columns",
)
MIRRORED_FORCE = Template(
    "E-IDN-096",
    "the horizontal force leans against the commanded tilt (factor {factor:.3g} on sin α, 1 is right); the servo or "
    "cell x is mirrored: turn the sign of `servo_slope` under `parameters`, {slope:g}, or of the loads of cell x",
)
WRONG_HORIZONTAL_FORCE = Template(
    "E-IDN-097",
    "the horizontal force is {factor:.3g} times the thrust of volts_z times sin α, and 1 is right; look at the plug "
    "of cell x, the points and units of cells z and x, and at `servo_slope`; are the channels swapped? Change their "
    "names",
)
OPPOSITE_PHASE = Template(
    "E-IDN-098",
    "the horizontal force leans against the commanded tilt (phase {phase:.0f}° at {frequency:g} rad/s); the servo or "
    "cell x is mirrored in this run, or its clock is late; look at plug and clock",
)
OTHER_CELL = Template(
    "E-IDN-099",
    "volts_{cell} is {value:.4g} V at rest, and cell {cell} without load {zero:.4g} V, more than a quarter of its "
    "calibration off; calibrate it anew, or are the channels swapped? Change their names",
)
COPY = Template(
    "E-IDN-100",
    "holds the readings of {name} once more; a repetition is a run of its own, so leave one out",
)
NO_FREE_HEIGHT = Template(
    "E-IDN-101", "the runs with nothing below are missing; add runs at {height:g} m or more, or lower free_height"
)
NO_LOW_HEIGHT = Template(
    "E-IDN-102",
    "the lowest height is {height:.4g} m, above {ratio:g} radii of the propeller ({limit:.3g} m): the ground "
    "effect is too small there; is the height in m, and `propeller_radius` right?",
)
TOO_FEW_LOW_HEIGHTS = Template("E-IDN-103", "two heights near the ground are needed at least; add runs")
TOO_FEW_AT_HEIGHT = Template("E-IDN-104", "{count} recordings at {height:g} m are too few; record {least} at least")
TOO_FEW_AT_FREQUENCY = Template(
    "E-IDN-105", "{count} recordings at {frequency:g} rad/s are too few; record {least} at least"
)

# -- logs of a craft ------------------------------------------------------------------------

NEITHER_REST_NOR_DISTANCE = Template("E-IDN-106", "holds neither rest nor distance; add one")
NO_LOG = Template("E-IDN-107", "no such file: {name}; correct the path")
COPY_OF_LOG = Template("E-IDN-108", "{name} holds what {other} does; each is a recording of its own, so leave one out")
NO_PARAMETER = Template("E-IDN-109", '{model} has no parameter "{name}"{hint}')
NO_OUTPUT = Template("E-IDN-110", '{model} has no output "{name}"{hint}')
TOO_FEW_RUNS = Template(
    "E-IDN-111", "{count} are too few: the interval comes from scatter between {least} or more runs; add runs"
)
DISTANCES_UNLIKE_FILES = Template("E-IDN-112", "{distances} distances for {files} files; give one each, or one for all")
NO_VALUE_OF_DISTANCE = Template("E-IDN-113", "no {parameter} makes the model cover the distance {distance:g}: {reason}")
NO_COMMAND = Template("E-IDN-114", "no command changes in it: nothing moves, and nothing can be matched; leave it out")
TOO_FEW_ROWS_AT_REST = Template(
    "E-IDN-115", "{rows} rows of {output} at rest, and {least} are needed; log longer (the thesis took 20 s)"
)
CONSTANT_OUTPUT = Template(
    "E-IDN-116", "{output} is {value:g} in every row: a dead channel; choose a window, or leave the log out"
)
SATURATED_OUTPUT = Template(
    "E-IDN-117",
    "{output} is {low:g} or {high:g} in {share:.0%} of its rows: saturated, or coarser than its noise; choose a "
    "window, or leave the log out",
)
SWINGING_OUTPUT = Template(
    "E-IDN-118",
    "{output} swings slowly, {ratio:.3g} times the variance from row to row: not at rest; choose a window, or leave "
    "the log out",
)
MOVING_OUTPUT = Template(
    "E-IDN-119",
    "{output} moves by {change:.3g} from the first half to the second: not at rest; choose a window, or leave the log "
    "out",
)
DRIFTING_OUTPUT = Template(
    "N-IDN-120", "{output} drifts: its variance about the mean is {ratio:.3g} times that about a straight line"
)
NO_VALUE_BY_OBSERVER = Template(
    "N-IDN-121", "the observer of App. F reaches the distance of some run with no {parameter}"
)

# -- results --------------------------------------------------------------------------------

OUTLIER = Template(
    "W-IDN-122",
    "{recording} is out of line: {name} is {value:.4g}, and {others:.4g} in the others; look at height, battery, cell "
    "and clock of this run",
)
OUTLIERS = Template(
    "W-IDN-123",
    "{recordings} are out of line: {name} is {value:.4g}, and {others:.4g} in the others; look at height, battery, "
    "cell and clock of these runs",
)
NOISE_FALLS = Template(
    "W-IDN-124",
    "volts_{cell} has less noise after the step than at rest: the cell or its amplifier is at its end; take a larger "
    "range or a smaller step",
)
EARLY_STEP = Template(
    "E-IDN-125",
    "the force moves some {delay:.2g} s before its command: the cells are ahead of the commands by as much; record "
    "both by one clock, shift the columns of volts, or correct `low_pass`",
)
LATE_STEP = Template(
    "W-IDN-126",
    "the mean response misses the curve of first order by up to {miss:.2g} % of the step, more than the scatter of the "
    "repetitions: the force answers some {delay:.2g} s late, as a pure delay does, and with that delay the lag is "
    "{lag:.2g} s; look at the clocks of commands and cells, and at `low_pass`",
)
NOT_FIRST_ORDER = Template(
    "W-IDN-127",
    "the mean response misses the curve of first order by up to {miss:.2g} % of the step, more than the scatter of the "
    "repetitions: it is not of first order, so the lag has no physical meaning; look at the cell, its range, "
    "`low_pass` and the motor",
)
HUM = Template(
    "W-IDN-128",
    "the mean response misses the curve of first order by up to {miss:.2g} % of the step, more than the scatter of the "
    "repetitions: it is not of first order, so the lag has no physical meaning; a sine of {frequency:.2g} Hz is "
    "on it, in rows of {rate:.3g} Hz to which faster ones fold: is it hum of the mains, or an oscillation? Shield or "
    "filter the cell",
)
EARLY_SINES = Template(
    "W-IDN-129",
    "phases miss those of first order by up to {miss:.2g}°, more than the scatter: the force is some {delay:.2g} s "
    "ahead of the sines, so look at the clocks of commands and cells, and at `low_pass`",
)
LATE_SINES = Template(
    "W-IDN-130",
    "phases miss those of first order by up to {miss:.2g}°, more than the scatter: the force answers some {delay:.2g} "
    "s late, as a pure delay does; look at the clocks of commands and cells, at `low_pass` and at `servo_slope`",
)
WRONG_SIZES = Template(
    "W-IDN-131",
    "sizes of the sines miss those of first order by up to {miss:.2g} %, more than the scatter: is cell x or its "
    "amplifier at its end, or does the battery sag?",
)
HARMONICS = Template(
    "W-IDN-132",
    "the force has harmonics of the sines that the tilt has not, up to {size:.2g} gf, beyond the scatter: is cell x "
    "or its amplifier at its end, or loose?",
)
THESIS_SINES = Template(
    "N-IDN-133",
    "The mean of nine rows costs the thesis' points {loss:.2f} dB at {frequency:g} rad/s. Ours are compared with the "
    "same commands through the bench's equations: hold, dead band, sine of the angle.",
)
RATIOS_WITHOUT_LOGARITHM = Template(
    "N-IDN-134",
    "{count} of {total} single ratios are Γ ≤ 1, where ln((Γ−1)/Γ) has no value: the thesis' estimator leaves them out "
    "and is biased by it.",
)
VALIDATION = Template(
    "N-IDN-135", "Validation at {duty:g} % of duty, not used in the fit: Γ is missed by {rms:.4f} (rms)."
)
WRONG_GROUND_EFFECT = Template(
    "W-IDN-136",
    "Γ is {value:.3f} at {ratio:.2f} radii where the fitted exponent gives {model:.3f}, more than the scatter "
    "explains: look at `propeller_radius` and at the heights, which are those of the propeller over the ground",
)
THESIS_STEPS = Template(
    "N-IDN-137",
    "As the thesis reads it: {ways}; single fits {mean:.1f} ± {half:.1f} ms (± is 1.96 σ of one test).",
)
SLOW_ROWS = Template(
    "W-IDN-138",
    "rows are {step:.3g} s apart, more than the lag of {lag:.3g} s: nothing of its shape is in them, and the number "
    "rests on the equation of first order; record faster",
)
SINE_BENDS = Template(
    "N-IDN-139", "63 % of sin α after 25° comes at 0.961 τ, for the sine bends before the angle settles."
)
CONVERTER_STEPS = Template(
    "N-IDN-140",
    "Over the whole tilt the cell moves by {steps:.1f} steps of the converter ({change:.1f} mV): noise and the low "
    "pass, not its resolution, let it be read.",
)
NO_MOMENT = Template(
    "E-IDN-141",
    "volts_m does not answer the sweep of the tilt, beyond its noise: look at the cell, its plug and its wires",
)
DRIFTING_MOMENT = Template(
    "W-IDN-142",
    "cell m drifts by {drift:.2g} N·m over the sweep (most beyond its noise in {recording}), by which the arm is off "
    "some {shift:.2g} m of {arm:.3g} m: let the bench warm up, sweep faster, or sweep there and back",
)
PROJECTIONS = Template(
    "N-IDN-143",
    "V(α) is off cos α by {vertical:.4f} at most, H(α) off sin α by {horizontal:.4f}, in bins of 2.5°: sine and cosine "
    "project it.",
)
DEGREE = Template("N-IDN-144", "r² = {r2:.4f} (eq 4.22); lowest degree within one standard error of the best: {degree}")
IDLE_READINGS = Template(
    "W-IDN-145",
    "{idle} of {total} readings are without thrust, which begins at {duty:.2f} %: T = max(0, a + b·δ) is no line "
    "there, and they are left out",
)
SHORT_RANGE = Template(
    "N-IDN-146",
    "The vertical cell leaves its range above {limit:.2f} %; samples below {end:.2f} % are used, not up to {top:.2f} "
    "%: a cell of a larger range would show the rest.",
)
DRIFTING_TARE = Template(
    "W-IDN-147",
    "cell z reads {drift:.3g} gf more at the end, without thrust again, than at rest (most in {recording}, {most:.3g} "
    "gf): it drifts, and offset and slope are off by as much; record shorter ramps, or with a warm cell",
)
BENT_THRUST = Template(
    "W-IDN-148",
    "{reason}. The intervals of thrust_offset and thrust_slope reach over the tangents from {low:.2f} to {high:.2f} %; "
    "choose a `window` about the duty that is flown, and look at the cell's calibration",
)

# -- plausibility of results ----------------------------------------------------------------

NO_INTERVAL = Template(
    "E-IDN-149",
    "{name} comes out as {value:.4g}{unit} without an interval: the recordings do not determine it; {cure}",
)
NO_VALUE = Template("E-IDN-150", "{name} has no value: the recordings do not determine it; {cure}")
LAG_AT_LIMIT = Template(
    "E-IDN-151", "{name} is {value:.4g} s, an end of the {low:g} to {high:g} s that are tried; {cure}"
)
IMPOSSIBLE_VALUE = Template(
    "E-IDN-152", "{name} comes out as {value:.4g}{unit}, and {low:g} to {high:g}{unit} is possible; {cure}"
)
WIDE_INTERVAL = Template(
    "W-IDN-153",
    "the interval of {name}, {first:.4g} to {last:.4g}{unit}, contains impossible values ({low:g} to {high:g}{unit} is "
    "possible): the recordings determine it poorly; look for one that differs, or record more",
)
WRONG_PROJECTION = Template(
    "W-IDN-154", "{name} is {value:.4g} ± {half:.2g}, not 1, so the {function} does not project it; {cure}"
)

# -- repetitions ----------------------------------------------------------------------------

ODD_COMMAND = Template(
    "W-IDN-155",
    "{column} of {recording} differs from the other repetitions by {difference:+.3g} % in `window` and {rest:+.3g} % "
    "at rest, and volts_{cell} does not: the column is shifted or scaled; correct it, or leave the file out",
)
OTHER_DUTY = Template(
    "E-IDN-156",
    "duty is {duty:.4g} % in `window`, and {usual:.4g} % in most runs: runs of another duty are read as validation, "
    "which needs some at each height; correct the column, or leave the file out",
)
LOW_VOLTAGE = Template(
    "E-IDN-157",
    "volts_{cell} is {value:.3g} V at most, and the lowest voltage of the cell's calibration is {limit:.3g} V: the "
    "column is scaled or in another unit, or the cell is unplugged; write it in V, or look at the plug and record anew",
)
MIRRORED_REPETITIONS = Template(
    "W-IDN-158",
    "{name} is {value:.4g} in {recordings}, and {others:.4g} in the others, as large with the opposite sign: a cell or "
    "a command is mirrored in one group; turn its sign, or leave the files out",
)
ODD_POINT = Template(
    "E-IDN-160",
    "the point of {load:g} {unit} at {volts:g} V lies {miss:.2g} {unit} off the curve through the other points, "
    "{times:.0f} times the stated error of a load: is it mistyped? Correct it, or leave it out",
)
SLIP = Template(
    "W-IDN-163",
    "cell {cell} jumps by {size:.2g} {unit} within the window (most in {recording}), which the response does not "
    "explain: did the rig slip or touch something? Fasten it, and record anew",
)
EARLY_SWEEP = Template(
    "W-IDN-161",
    "the horizontal force is some {delay:.2g} s ahead of the commanded tilt: were the commands recorded late? Record "
    "both by one clock, or shift the columns of volts",
)
LATE_SWEEP = Template(
    "W-IDN-162",
    "the horizontal force is some {delay:.2g} s behind the commanded tilt, more than the lag of a servo: look at the "
    "clocks of commands and cells",
)
