"""Messages of bench and craft identification."""

from typing import Any, NamedTuple


class Template(NamedTuple):
    """A message with fields in braces, as for `str.format`."""

    code: str
    text: str

    def __call__(self, **fields: Any) -> str:
        """Return the message with these values."""
        return self.text.format_map(fields)


PULSE = "such as 7.5 for a pulse of 1500 µs in a frame of 20 ms"

# -- commands of a run ----------------------------------------------------------------------


# Cures for a planned run and for a recording; `place` is that of the test in its protocol.

# -- columns of a recording -----------------------------------------------------------------


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
THESIS_STEPS = Template(
    "N-IDN-137",
    "As the thesis reads it: {ways}; single fits {mean:.1f} ± {half:.1f} ms (± is 1.96 σ of one test).",
)
SINE_BENDS = Template(
    "N-IDN-139", "63 % of sin α after 25° comes at 0.961 τ, for the sine bends before the angle settles."
)
CONVERTER_STEPS = Template(
    "N-IDN-140",
    "Over the whole tilt the cell moves by {steps:.1f} steps of the converter ({change:.1f} mV): noise and the low "
    "pass, not its resolution, let it be read.",
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
