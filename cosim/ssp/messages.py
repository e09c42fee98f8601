"""Messages of SSPs."""

from cosim.base.messages import Template

# Files
TOO_LARGE = Template("E-SSP-001", "it has more than the {megabytes:.0f} MB that are read; split it")
UNREADABLE = Template("E-SSP-002", "cannot be read: {reason}")
NOT_AN_SSP = Template("E-SSP-003", "is no SSP: {error}")
NOT_UNPACKED = Template("E-SSP-004", "cannot be unpacked: {reason}")
XML_VIOLATION = Template("E-SSP-005", "breaks the rules of XML: {reason}")
SCHEMA_VIOLATION = Template("W-SSP-006", "breaks the schema of SSP: {reason}")
NOT_IN_PACKAGE = Template("E-SSP-007", '"{name}" is not in the package; put the file into resources/ and name it so')
OUTSIDE_PACKAGE = Template(
    "E-SSP-008", '"{name}" leads out of the package; put the file into resources/ and name it so'
)
NO_SUCH_FILE = Template("E-SSP-009", 'no file "{name}" in it{hint}')
INVALID_FILE_NAME = Template("E-SSP-010", '"{name}" is no name of a file')

# Elements and attributes
WRONG_ELEMENT = Template("E-SSP-011", "it should be {tag}")
MISSING_ELEMENT = Template("E-SSP-012", "it has no {tag}; add one")
MISSING_ATTRIBUTE = Template("E-SSP-013", "it has no {name}; add it")
NO_NAME = Template("E-SSP-014", "it has no name; add one")
NOT_FINITE = Template("E-SSP-015", "{name} {value}: it is a finite number")
UNKNOWN_VERSION = Template("E-SSP-016", "version {version} is not known here; {versions} are")
TRANSFORMATION_NOT_RUN = Template(
    "E-SSP-017", "is not run here; ssc:LinearTransformation is, or let the FMU map the value"
)
ZERO_FACTOR = Template("E-SSP-018", "factor 0 is that of no unit; give another")
STEP_NOT_POSITIVE = Template("E-SSP-019", "{name} {step:g} s: a communication step is more than 0 s")
STOP_BEFORE_START = Template(
    "E-SSP-020", "stopTime {stop:g} s is not after startTime {start:g} s; give a later stopTime"
)

# Systems and components
NOT_AN_ELEMENT = Template("E-SSP-021", "is no element of a system; ssd:Component and ssd:System are")
DOUBLED_ELEMENT = Template("E-SSP-022", "another element has this name; rename one of them")
DOUBLED_CONNECTOR = Template("E-SSP-023", "another connector has this name; keep one of them")
SIGNAL_DICTIONARY = Template("E-SSP-024", "signal dictionaries are not read here; connect outputs to inputs")
COMPONENT_NOT_AN_FMU = Template("E-SSP-025", "type {type} is not read here; components are {fmu}")
COMPONENT_AN_SSP = Template("E-SSP-026", "type {type} is not read here; put its systems into this file")
NO_FMU_NAMED = Template("E-SSP-027", "it has no source, so there is nothing to run; name its FMU")
INTERFACE_NOT_RUN = Template("E-SSP-028", "implementation {interface} is not run here; {interfaces} are")
NO_SUCH_VARIABLE = Template("E-SSP-029", "{fmu} has no such variable{hint}")

# Connections
UNKNOWN_ELEMENT = Template("E-SSP-030", "{side}Element {name} is not in its system{hint}")
UNKNOWN_CONNECTOR = Template("E-SSP-031", "{side}Connector: {owner} has no connector {name}{hint}")
SEVERAL_SOURCES = Template("E-SSP-032", "two sources for {target}: {first} and {second}; keep one")
UNIT_MISMATCH = Template(
    "E-SSP-033",
    "unit mismatch: [{source}] to [{target}]; where they are the same all the same, say so by "
    'suppressUnitConversion="true"',
)

# Parameters
BINDING_TYPE = Template("E-SSP-034", "type {type} is not read here; {read} is")
NO_CONTENT = Template("E-SSP-035", "it has neither a source nor {tag} in it; add one")
SOURCE_BASE = Template("E-SSP-036", "sourceBase {base} is not read here; take the file out of the FMU")
NO_VALUE = Template("E-SSP-037", "it has no value; add one such as ssv:Real")
ARRAY = Template("E-SSP-038", "{count} values; arrays are not read here, bind their elements by name")
NOT_BOOLEAN = Template("E-SSP-039", "value {value}: it is true or false")
NOT_WHOLE = Template("E-SSP-040", "value {value}: it is a whole number")
UNKNOWN_TYPE = Template("E-SSP-041", "is no type of a value{hint}")
TRANSFORMED_TEXT = Template("E-SSP-042", "a linear transformation of {value}; it takes numbers")
UNKNOWN_SOURCE = Template("W-SSP-043", "the parameter set has no {name}{hint}")
PARAMETER_WITHOUT_TARGET = Template("W-SSP-044", "parameter {name} is of nothing here, and is left out{hint}")
PARAMETER_WITHOUT_FMU = Template("W-SSP-045", "parameter {name} leads to no FMU, and is left out")
