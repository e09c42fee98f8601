"""Messages of the signal browser."""

from cosim.base.messages import Template

NO_ROWS = Template(
    "E-VIE-001", "has no rows to draw{status}; give folders of runs, or tables with time in the first column"
)
NOTHING = Template("E-VIE-002", "holds no results with rows; run a scenario first, or name folders and tables")
NO_ROW = Template("E-VIE-003", "has no row yet; wait for the end of the run, or run it again")
LEFT_OUT = Template("W-VIE-004", "{run} is left out: {reason}")
EARLIER = Template("N-VIE-005", "the newest {count} of {all} results are shown; name the others")
SLOW_ROWS = Template(
    "N-VIE-006", "{file} is read as a whole each time, because pyarrow is not installed; install it with {command}"
)
LOST = Template("W-VIE-008", "{run} was removed or replaced; what is drawn of it stays, zoom shows the others")
UNREADABLE = Template("E-VIE-009", "cannot be read: {reason}")
NOT_WRITTEN = Template(
    "E-VIE-017", "cannot be written: {reason}; download the layout, or name another file as --layout"
)
WRONG_REQUEST = Template("E-VIE-010", "the request is not understood: {reason}")
UNKNOWN_NAME = Template("E-VIE-011", "{name} stands for no signal; use {names}")
WRONG_FORMULA = Template(
    "E-VIE-012", "{text}: {reason}; use + - * / **, numbers, the letters of signals and {functions}"
)
NAME_TAKEN = Template("E-VIE-013", "{name} is a signal of the run; give another name")
MANY_CELLS = Template("E-VIE-014", "these are {count:.0f} million values, more than {limit:.0f} million; zoom in first")
WRONG_LAYOUTS = Template("E-VIE-015", "is no file of layouts of `cosim view`; name another one as --layout")
PAGE = Template("N-VIE-016", "signals: {url}")
OTHER_QUANTITY = Template(
    "E-VIE-018",
    "{text0} is in {unit0} and {text1} in {unit1}, which measure different quantities; write number({text1}) for its "
    "number without unit",
)
NO_ARGUMENT = Template(
    "E-VIE-019",
    "{text0} is in {unit0}; this function takes an angle, a ratio, or a time in seconds; write number({text0}) for its "
    "number without unit",
)
NO_ROOT = Template(
    "E-VIE-020",
    "{text0} is in {unit0}, which has no power {exponent}; write number({text0}) for its number without unit",
)
UNIT_WITH_POWERS = Template(
    "E-VIE-021",
    "{text0} is in {unit0}, and its exponent {exponent} is no number; write number({text0}) for its number "
    "without unit",
)
NO_TEMPERATURE = Template(
    "E-VIE-022",
    "{text0} in {unit0} is a sum or a multiple of temperatures, but no temperature; take a mean, a difference, or "
    "number(…) of each part",
)
OWN_SIGNAL = Template("E-VIE-023", "{name} would be derived from itself: {way}; give another name")
GAPS = Template("N-VIE-024", "{name}: {count} without values, at most {longest:.3g} s, are bridged by straight lines")
NO_VALUE = Template("N-VIE-025", "{name} has no value in any row")
UNKNOWN_UNITS = Template("N-VIE-026", "{name}: {units} is no known unit, so that the result has none")
NOT_DERIVED = Template("E-VIE-029", "{name} is no derived signal")
NEEDED = Template("E-VIE-030", "{others} is derived from {name}; remove that first")
ROUNDED = Template(
    "N-VIE-028", "{run}: integers of {names} above 2^53 are drawn as the nearest double; the cursor shows all digits"
)
INEXACT = Template("N-VIE-031", "{run}: integers of {names} above 2^53 are read as the nearest double")
WRONG_LAYOUT = Template("E-VIE-027", "{place}: {reason}; correct it, or save this layout again in the page")
