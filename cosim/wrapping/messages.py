"""Messages of wrapped FMUs."""

from cosim.base.messages import Template

OTHER_VERSION = Template("E-WRP-001", "{file} is FMI {version}; terms are added to FMI 2.0 and 3.0")
UNKNOWN_VARIABLE = Template("E-WRP-002", '{file} has no variable "{name}"')
NO_REAL = Template("E-WRP-003", "{name} of {file} is no real scalar; terms act on real scalars")
NAME_TAKEN = Template("E-WRP-004", '{file} already has a variable "{name}"; a parameter of a term needs another name')
OTHER_STATES = Template(
    "E-WRP-005", "the terms are for the states {expected}, but {file} has {actual}; print them for this FMU"
)
NO_INTERFACE = Template("E-WRP-006", "the terms act on derivatives, and {file} has no model exchange")
NO_SUBSTEP = Template(
    "E-WRP-007", "the terms have a memory, which model exchange needs a substep for; give a substep [s]"
)
NO_COMPILER = Template(
    "E-WRP-008",
    "the refined FMU of {file} needs a small library around the original, and no platform of it can be compiled for: "
    "{reasons}",
)
NO_LIBRARY = Template("E-WRP-009", "{file} has no library for {identifier}; there is nothing to wrap")
SUBSTEP_NOT_POSITIVE = Template("E-WRP-010", "the substep is {substep:g} s; give a positive number")
NO_START = Template("E-WRP-011", "{name} of {file} has no start value; only variables with one take another")
NO_PARAMETER = Template("E-WRP-012", 'the delay "{name}" is no parameter of the terms')
ONE_INSTANCE = Template(
    "E-WRP-015", "the terms need a second instance of {file}, which allows one instance in a process"
)

# Reasons why a platform is left out
UNKNOWN_PLATFORM = Template("W-WRP-013", "{platform} is not among the platforms to build for")
NO_LIBRARY_ON_PLATFORM = Template("W-WRP-014", "{platform} has no library for {identifier}")
