"""Messages about the files that an FMU carries."""

from cosim.base.messages import Template

FILE_MISSING = Template("W-REL-001", "{manifest} names {source} ({role}), which is not in the FMU")
OUTSIDE = Template("W-REL-002", "{manifest} names {source} ({role}), outside the FMU; it is not read")
LISTED = Template("N-REL-003", "carries {source}: {role}, {type}{labels}{description}; not run")
NOT_RUN = Template("N-REL-004", "carries {count} with expected results; not run without loading")
REPRODUCED = Template("N-REL-005", "{experiment}: {count} within {share:g} % of the range; {largest}")
DEVIATES = Template("E-REL-006", "{experiment} is not reproduced: {reasons}; {largest}")
FAILED = Template("E-REL-007", "{experiment} cannot be run: {error}")
NOT_COMPARED = Template(
    "E-REL-012", "{experiment} is run to its end, and cannot be compared with its expected results: {error}"
)
NOTHING_COMMON = Template("E-REL-013", "none of its signals is a signal of the FMU: {names}")
NOTHING_EXPECTED = Template("N-REL-008", "{experiment}: run to its end; no expected results")
MEASURED = Template("N-REL-009", "{experiment}: root mean square of the error {errors}")
BY_MODEL_EXCHANGE = Template(
    "N-REL-011",
    "{experiment} is run by model exchange: co-simulation would take {count:.0e} internal steps of {step:g} s",
)
NOT_IN_FMU = Template("W-REL-010", "{experiment}: the FMU has no {names}; {count} of the expected results not compared")
OTHER_CHECKSUM = Template(
    "W-REL-014", "{source} ({role}) has another checksum than {manifest} says: one of them was changed later"
)
UNCHECKED = Template(
    "W-REL-015", '{source} ({role}) has a checksum of type "{type}", which is not checked; known are {known}'
)
