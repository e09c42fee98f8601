"""Messages of logs."""

from cosim.base.messages import Template

# -- columns --------------------------------------------------------------------------------------

UNNAMED_COLUMN = Template("E-LOG-001", "the column has no name; name it or delete it")
ONLY_TIME = Template("E-LOG-002", "holds no column beside the time; a log holds what was measured")
WRONG_UNIT = Template("E-LOG-003", '"{unit}" is no unit of {name}, which is in {wanted}; known here: {alternatives}')
OTHER_MODEL = Template(
    "E-LOG-004",
    "holds none of the columns of the model: {names}; "
    "a log of another model is checked with --model FILE:CLASS and replayed with --plant FMU; "
    "where columns have other names, --column COLUMN=VARIABLE, or `columns` of a study, says which is which",
)
SIMILAR_INPUT = Template(
    "E-LOG-005",
    '"{column}" is no column of the model; did you mean "{name}", which is missing? '
    "A log holds every input of the model: {inputs}",
)
MISSING_INPUT = Template(
    "E-LOG-006",
    'input "{name}" is missing; a log holds every input of the model: {inputs}; for a column of another name say '
    "--column COLUMN={name}, or `columns` in a study",
)
NO_OUTPUT = Template(
    "E-LOG-007",
    "holds no output of the model{cure}; at least one of {outputs} is measured; where columns have other names, "
    "--column COLUMN=VARIABLE, or `columns` of a study, says which is which",
)
TIME_NOT_FIRST = Template("E-LOG-008", '"{column}" is to be the time, which is the first column, "{first}"')
UNKNOWN_VARIABLE = Template(
    "E-LOG-009", '"{column}" is to be {name}, which the model does not have{cure} (it has {names})'
)
UNKNOWN_COLUMN = Template("E-LOG-010", 'has no column "{column}"{cure} (it is to be {name})')
COLUMN_OPTION = Template("E-LOG-011", '--column "{text}" is not COLUMN=VARIABLE, as in measured_speed=motor.w')
TOO_FEW_ROWS = Template("E-LOG-012", "holds {count}; a log has at least two, and some hundred to be of use")
EMPTY_COLUMN = Template("E-LOG-013", 'column "{name}" holds no value (NaN in every row); delete the column')
ABSURD_VALUE = Template("E-LOG-014", '{name} is {value:g} here, far beyond the rest: a mark for "invalid"? Then {cure}')
UNKNOWN_UNIT = Template("W-LOG-016", '"{unit}" is no unit known here: its numbers are taken as they are')
SIMILAR_COLUMN = Template("W-LOG-017", "is not read: the model has none of this name{cure}")
UNREAD_COLUMNS = Template("N-LOG-018", "{count} not read, for the model has none of this name: {names}")
TEXT_COLUMNS = Template("N-LOG-019", "{count} of text not read: {names}")
NO_MODEL = Template("N-LOG-020", "checked without a model: --model FILE:CLASS holds names, units and signs against one")

# -- clock ----------------------------------------------------------------------------------------

_JITTER = (
    "rows are {step} apart, give or take {spread} (at most {worst}); "
    "replays step at their times, the filter of `cosim refine` at equal ones"
)
STRONG_JITTER = Template("W-LOG-021", _JITTER)
JITTER = Template("N-LOG-022", _JITTER)
MISSING_ROWS = Template(
    "W-LOG-023",
    "{rows} missing in {places}, first after t = {first:.6g} s, the longest {longest}; "
    "commands are held over them, so what was commanded in between is not replayed",
)
SHORT_LOG = Template("W-LOG-024", "the log lasts {duration}; {usual} s and more tell more")
LATE_START = Template(
    "N-LOG-025", "time starts at {start:.0f} s; a model whose effects depend on time takes it as it is"
)
UNIT_OF_TIME = Template(
    "E-LOG-026",
    "rows are {step}\u00a0s apart, the model is made for {rate}\u00a0s; is the time in {unit}? "
    'Then call it "time [{unit}]", or "time [s]" if it is not',
)
LOST_COMMANDS = Template(
    "E-LOG-027",
    "rows are {step}\u00a0s apart, the model is made for {rate}\u00a0s; "
    "commands in between are lost; log every command",
)
SLOW_ROWS = Template(
    "W-LOG-028",
    "rows are {step}\u00a0s apart, the model is made for {rate}\u00a0s; "
    "what was commanded between two rows is not in the log, and no command but that of a row acts",
)
FAST_ROWS = Template(
    "W-LOG-029",
    "rows are {step}\u00a0s apart, the model is made for {rate}\u00a0s: "
    "each row is a step, and takes its time; fewer would do",
)
UNEVEN_ROWS = Template(
    "N-LOG-030", "rows are {step}\u00a0s apart, the model is made for {rate}\u00a0s, no whole number of rows a step"
)
ROWS_PER_STEP = Template(
    "N-LOG-031", "rows are {step}\u00a0s apart, the model is made for {rate}\u00a0s: {count} a step"
)

# -- inputs and outputs ---------------------------------------------------------------------------

CONSTANT_INPUT = Template(
    "N-LOG-032", "is constant at {value}: it excites nothing, and effects that act only through it cannot be identified"
)
NO_EXCITATION = Template("W-LOG-033", "no input moves: such a log says next to nothing about a model")
EXCITATION = Template(
    "N-LOG-034", "moves {rms} (rms) with 95 % of its power below {bandwidth}, between {low} and {high}{share}"
)
ALIKE_INPUTS = Template(
    "N-LOG-035",
    "moves {direction} {other} (correlation {correlation}): what one does cannot be separated from what the other does",
)
SPARSE_OUTPUT = Template("N-LOG-036", "measured in {share} of the rows, every {interval}")
CONSTANT_OUTPUT = Template("W-LOG-037", "is constant at {value} throughout; check that the sensor is connected")
SLOWER_SENSOR = Template(
    "W-LOG-038",
    "changes only every {rows:.0f} rows: a slower sensor, held. "
    "Leave the cells in between empty, or the hold passes for a delay",
)
FROZEN_SENSOR = Template(
    "W-LOG-039",
    "is exactly {value} in {rows} rows from t = {first:.6g} s, although its noise is larger elsewhere: the sensor "
    "was frozen, at the end of its range, or at rest where it makes no noise",
)
OUTLIERS = Template(
    "W-LOG-040",
    "has {count} that its neighbours and the model do not explain, first at t = {first:.6g} s, the farthest off by "
    "{worst}; `cosim refine` leaves such readings out, other commands take them as they are: leave the cells empty",
)

# -- units and signs ------------------------------------------------------------------------------

_OPPOSITE_RATE = (
    "has the opposite sign of d {name}/dt (slope {slope}); "
    "turn one of them round: the rate is positive where the signal grows"
)
OPPOSITE_RATE = Template("E-LOG-041", _OPPOSITE_RATE)
OPPOSITE_RATE_BY_NAME = Template("W-LOG-042", _OPPOSITE_RATE)
_DEGREES = "is {factor} times what {other} says: one is in degrees, the other in radians. {cure}"
DEGREES = Template("E-LOG-043", _DEGREES)
DEGREES_BY_NAME = Template("W-LOG-044", _DEGREES)
SCALED_RATE = Template(
    "W-LOG-045", "integrates to {factor} times the change of {name}: a scale is off, or one of them is limited"
)
BIASED_RATE = Template("N-LOG-046", "is {bias} above d {name}/dt throughout: a bias of one of the sensors")
UNWRAPPED_ANGLE = Template("N-LOG-047", "has {count} of a turn, first at t = {first:.6g} s; undone, it is continuous")
ANGLE_BEYOND_BOUNDS = Template(
    "E-LOG-048", "reaches {size} rad, beyond what the model allows ({low} to {high}); {cure}"
)
LARGE_ANGLE = Template("W-LOG-049", "reaches {size} rad; {cure}")
JUMPING_ANGLE = Template(
    "W-LOG-050", "jumps by more than half a turn {count}, first at t = {first:.6g} s; an angle is continuous"
)
REVERSED_AXIS = Template(
    "W-LOG-051",
    "the body moves sideways unless {x}, {y} or {heading} is turned round: "
    "world Y points left and {heading} is positive to the left",
)
EXCHANGED_AXES = Template(
    "W-LOG-069", "the body moves sideways unless {x} and {y} are exchanged: are the columns swapped?"
)
JUMPING_POSITION = Template(
    "W-LOG-070",
    "jumps by {size} in the row at t = {first:.6g} s, far more than in other rows: was the sensor set anew, or are two "
    "logs joined?",
)
JUMP_AGAINST_RATE = Template(
    "W-LOG-071", "jumps by {size} at one place, and {rate} shows no such motion: was the sensor set anew?"
)
DISAGREEING_RATE = Template(
    "W-LOG-072",
    "does not follow the integral of {rate} (correlation {correlation}), though both move far beyond their noise: "
    "one of them has another sign in a part of the log, or belongs to another body",
)

_OTHER_SIZE = 'is its unit {unit}? Then call the column "{name} [{unit}]"'
BEYOND_BOUND = Template("E-LOG-058", "reaches {size}, far beyond the {reference} that the model allows; " + _OTHER_SIZE)
OTHER_SIZE = Template("W-LOG-059", "reaches {size}, where the model starts at {reference}; " + _OTHER_SIZE)
BEYOND_EVERY_UNIT = Template(
    "E-LOG-061", "reaches {size}, far beyond the {reference} that the model allows: is it scaled, or in another unit?"
)
_OTHER_SLOPE = "moves with the model, but {slope} ± {error} times as far; " + _OTHER_SIZE
OTHER_SLOPE = Template("E-LOG-062", _OTHER_SLOPE)
PERHAPS_OTHER_SLOPE = Template("W-LOG-060", _OTHER_SLOPE)
_CONVERTED_UNIT = (
    "was converted from {unit} to {to}, but agrees with the model without this conversion: "
    'leave "[{unit}]" out of the header'
)
CONVERTED_UNIT = Template("E-LOG-063", _CONVERTED_UNIT)
PERHAPS_CONVERTED_UNIT = Template("W-LOG-068", _CONVERTED_UNIT)
OTHER_RANGE = Template("W-LOG-073", "moves {ratio} times as far as the model; " + _OTHER_SIZE)
WRONG_SIGN = Template(
    "W-LOG-064",
    "moves against the model ({slope} ± {error} times as far, correlation {correlation}): "
    "it, or a command, has the wrong sign",
)
SWAPPED = Template(
    "W-LOG-065",
    "moves as {other} does in the model (correlation {correlation}), and {other} as {name}: are the columns swapped?",
)
_DELAY = "{direction} the model by {delay} ± {error}: {cause}, {doubt}"
DELAY = Template("W-LOG-066", _DELAY)
POSSIBLE_DELAY = Template("N-LOG-067", _DELAY)

# -- tables ---------------------------------------------------------------------------------------
