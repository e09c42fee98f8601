"""Messages of the signal browser."""

from cosim.base.messages import Template

NO_ROWS = Template(
    "E-VIE-001", "has no rows to draw{status}; give folders of runs, or tables with time in the first column"
)
NOTHING = Template("E-VIE-002", "holds no results with rows; run a scenario first, or name folders and tables")
NO_ROW = Template("E-VIE-003", "has no row yet; wait for the end of the run, or run it again")
LEFT_OUT = Template("W-VIE-004", "{run} is left out: {reason}")
EARLIER = Template("N-VIE-005", "the newest {count} of {all} results are shown; name the others")
LOST = Template("W-VIE-008", "{run} was removed or replaced; what is drawn of it stays, zoom shows the others")
UNREADABLE = Template("E-VIE-009", "cannot be read: {reason}")
NOT_WRITTEN = Template(
    "E-VIE-017", "cannot be written: {reason}; download the layout, or name another file as --layout"
)
WRONG_REQUEST = Template("E-VIE-010", "the request is not understood: {reason}")
NAME_TAKEN = Template("E-VIE-013", "{name} is a signal of the run; give another name")
MANY_CELLS = Template("E-VIE-014", "these are {count:.0f} million values, more than {limit:.0f} million; zoom in first")
WRONG_LAYOUTS = Template("E-VIE-015", "is no file of layouts of `cosim view`; name another one as --layout")
PAGE = Template("N-VIE-016", "signals: {url}")
OWN_SIGNAL = Template("E-VIE-023", "{name} would be derived from itself: {way}; give another name")
NOT_DERIVED = Template("E-VIE-029", "{name} is no derived signal")
NEEDED = Template("E-VIE-030", "{others} is derived from {name}; remove that first")
ROUNDED = Template(
    "N-VIE-028", "{run}: integers of {names} above 2^53 are drawn as the nearest double; the cursor shows all digits"
)
INEXACT = Template("N-VIE-031", "{run}: integers of {names} above 2^53 are read as the nearest double")
WRONG_LAYOUT = Template("E-VIE-027", "{place}: {reason}; correct it, or save this layout again in the page")
