"""Messages of `cosim list`, `open` and `gc`, and on results named by number, name or pattern."""

from cosim.base.messages import Template

NO_RESULTS = Template(
    "E-HIS-001", "no results here; run a command without --out first, or name their folder as --results"
)
UNKNOWN_NUMBER = Template(
    "E-HIS-002", "no results with the number {number}; `cosim list` shows the numbers, up to {last}"
)
REMOVED_NUMBER = Template(
    "E-HIS-014", "the results with the number {number}, {name}, were removed; `cosim list` shows all"
)
NO_MATCH = Template("E-HIS-003", "no results match{hint}; `cosim list` shows all")
SEVERAL = Template("E-HIS-004", "{count} results match: {names}; name one")
NO_FOLDER = Template("E-HIS-010", "no such folder; give the folder that has the results as --results")
NO_PAGE_OF_KILLED = Template("E-HIS-015", "has no report.html, because its command was killed; run it again")
NO_PAGE_YET = Template("E-HIS-016", "has no report.html yet, because its command has not ended")
NOT_RESULTS = Template("E-HIS-011", "holds no results of a command; give a number, a name or a folder in `cosim list`")
NO_REPORT = Template("E-HIS-005", "has no report.html; {cure}")
NOT_CONFIRMED = Template("E-HIS-006", "nothing is removed without an answer; add --yes")
REMOVED_BEFORE = Template("W-HIS-007", "{folder} is gone already")
NOT_REMOVED = Template("E-HIS-008", "cannot be removed: {reason}")
REPLACED = Template("E-HIS-012", "run {number} was removed or replaced after it was listed; repeat the command")
NO_PAGE_OF_DAMAGED = Template("E-HIS-013", "has no report.html, and its record is damaged: run the command again")
NO_PATH_OR_NAME = Template(
    "E-HIS-009",
    "no such folder or file; give the folder of a run, a table of its rows, or a number or name in `cosim list`{hint}",
)
