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
