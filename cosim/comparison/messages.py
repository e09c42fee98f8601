"""Messages of comparisons."""

from cosim.base.messages import Template

NO_COMMON_SIGNAL = Template("E-CMP-001", "shares no signal with {other}: it has {own}; that has {theirs}")
NO_COMMON_TIME = Template("E-CMP-002", "shares no time with {other}: it has {own}, that {theirs}")
NEGATIVE_TOLERANCE = Template("E-CMP-003", "{option} {value:g}: give a number that is not negative")
FILE_FOR_FOLDER = Template("E-CMP-004", "is a file; give the folder with the results of `cosim run`")
FOLDER_OF_OTHER_VERB = Template(
    "E-CMP-005", "holds no manifest.json; it is of `cosim {verb}`, which writes its page itself"
)
NO_MANIFEST = Template("E-CMP-006", "has no manifest.json; give the folder with the results of `cosim run`")
NO_SCENARIO = Template("E-CMP-007", "is no manifest of a run: there is no scenario in it, or it is torn; run it again")
NO_ROWS = Template("E-CMP-008", "has no rows: the run stopped before its first; run it again")

# Reasons why run b does not match run a
SIGNALS_BEYOND = Template("E-CMP-009", "{count} beyond the tolerance")
SIGNALS_DIFFER = Template("E-CMP-010", "{count} {verb}")
NOT_COMPARABLE = Template("E-CMP-011", "{name} is {note}")
SIGNALS_MISSING = Template("E-CMP-012", "{count} of {path} {verb} missing in {other}: {names}")
OTHER_END = Template("E-CMP-013", "{path} {verb} at {time:.6g} s, {other} at {later:.6g} s")
