"""Messages of FMU builds."""

from cosim.base.messages import Template

UNKNOWN_MACHINE = Template("E-FMI-001", "this machine, {machine} {system}, is none of {platforms}; name one of these")
NO_COMPILER = Template("E-FMI-002", "no C compiler is found in CC or on PATH; {remedy}")
NO_COMPILER_AT_ALL = Template("E-FMI-003", "no C compiler is found in CC or on PATH")
NO_CROSS_COMPILER = Template(
    "E-FMI-004", "no compiler for {platform} is found; {command}, which brings a compiler that crosses"
)
COMPILER_ERROR = Template("E-FMI-005", "{command} failed: {reason}")
NO_LIBRARY = Template("E-FMI-006", "{command} failed: it ended without an error and made no library{output}")
FUNCTION_MISSING = Template(
    "E-FMI-007", "{command} failed: it ended without an error, but what it made is no library that has {function}"
)
TIMEOUT = Template("E-FMI-008", "{command} was not done in {limit:g} s")
NOT_STARTED = Template("E-FMI-009", "{command}: {reason}")

# Files that an FMU carries (FMI-LS-REF)
OTHER_LAYERED_STANDARD = Template("E-FMI-010", "{name} is of the layered standard {standard}, not of {needed}")
ATTRIBUTE_MISSING = Template("E-FMI-011", "{name}: <{tag}> has no attribute {attribute}, or an empty one")
OTHER_ROOT = Template("E-FMI-012", "{name} begins with <{tag}>; <{needed}> is needed")
UNKNOWN_ROLE = Template(
    "E-FMI-013", '{name}: {source} has the role "{role}"; FMI-LS-REF has for example experiment, result, parameter'
)
NO_NUMBER = Template("E-FMI-014", '{name}: {attribute} is "{value}"; give a number')
UNKNOWN_TYPE = Template("E-FMI-015", "{name}: <{tag}> is of type {type}; only {needed} is read")
NO_EXPERIMENT = Template("E-FMI-016", "{name} has no experiment")
UNKNOWN_ELEMENT = Template("E-FMI-017", "{name}: FMI-LS-REF has no element <{tag}>")
UNKNOWN_ATTRIBUTE = Template(
    "E-FMI-020", "{name}: FMI-LS-REF has no attribute {attribute} of <{tag}>; known are {known}"
)
ADDED = Template("W-FMI-021", "{unknown}; it is left out")
OTHER_VERSION = Template("W-FMI-018", "{name} has version {version}; {known} are known; read as {taken}")
NO_DESCRIPTION = Template("W-FMI-019", "{name} has no fmi-ls-description, which FMI-LS-REF requires")
