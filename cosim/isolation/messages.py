"""Messages of worker processes and limits."""

from cosim.base.messages import Template

CRASH = Template("E-ISO-001", "{call} {end}")
CRASH_WITH_WORDS = Template("E-ISO-002", "{call} {end}; it said last: {words}")
LONG_CALL = Template(
    "E-ISO-003", "{call} takes longer than {limit:g} s (limits: {name}); raise this limit if the FMU is only slow"
)
LONG_RUN = Template(
    "E-ISO-004",
    "{call} was stopped: the run takes longer than {limit:g} s in all (limits: total); raise this limit or "
    "shorten the run",
)
LARGE_PROCESS = Template(
    "E-ISO-005",
    "{call}: the process and those that it started hold {size:.4g} MB, more than {limit:.4g} MB (limits: memory)",
)
UNSENDABLE_OBJECT = Template(
    "E-ISO-006",
    "cannot take over an object ({kind}: {reason}); define it in a module that can be imported, or run in this process"
    " (in_process=True, --in-process)",
)
NO_LIMIT = Template("E-ISO-007", "it is a number above 0 with its unit ({units}), {example} for one")
UNKNOWN_LIMIT = Template("E-ISO-008", "{name}: no such limit (known: {names})")
OUTPUT_LEFT_OUT = Template("N-ISO-009", "(the FMUs print more, which is left out)")
STREAMS_CHANGED = Template(
    "E-ISO-010", "{call} closed, read or wrote descriptors that the FMU did not open: it must leave them alone"
)
STREAMS_CHANGED_BY_ONE = Template(
    "E-ISO-011",
    "closed, read or wrote descriptors that it did not open; give them process: own, which shows the FMU",
)
