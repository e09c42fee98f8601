"""Messages of components: FMUs, sources and faults."""

from cosim.base.messages import Template

# -- reading an FMU --------------------------------------------------------------------------------

INVALID_NUMBER = Template("E-BLK-004", '{file} is not a valid FMU: {place} is "{value}", which is no number')
INVALID_WHOLE_NUMBER = Template(
    "E-BLK-005", '{file} is not a valid FMU: {place} is "{value}", which is no whole number'
)


# -- loading its library ---------------------------------------------------------------------------

NO_LIBRARY = Template("E-BLK-009", "it has no library for {platform} or another platform")
OTHER_PLATFORMS = Template("E-BLK-010", "it has no library for {platform}; it has some for {others}")
SOURCES_ONLY = Template(
    "E-BLK-011",
    "it has no library for {platform} or another platform; it has sources: --compile (in Python compile=True) compiles "
    "and runs them",
)
SOURCES_WITH_LIBRARIES = Template(
    "E-BLK-012",
    "it has no library for {platform}; it has some for {others}; it has sources: --compile (in Python compile=True) "
    "compiles and runs them",
)

# -- compiling its sources -------------------------------------------------------------------------


# -- calling it ------------------------------------------------------------------------------------

CALL_FAILED = Template("E-BLK-034", "{function} returned {status}")
CALL_FAILED_WITH_REASON = Template("E-BLK-035", "{function} returned {status}: {reason}")
END_BY_DISCARD = Template("N-BLK-037", "{function} returned Discard: the FMU ended the simulation early")
END_BY_DISCARD_WITH_REASON = Template(
    "N-BLK-038", "{function} returned Discard: the FMU ended the simulation early: {reason}"
)
VALUE_NOT_FINITE = Template(
    "E-BLK-041",
    "the value is {value}, which is no finite number; check the component's inputs and parameters, or take a "
    "shorter step",
)

# -- integrating its derivatives -------------------------------------------------------------------


# -- event mode and clocks ---------------------------------------------------------------------------


# -- FMUs on other machines ----------------------------------------------------------------------------

SERVER_SILENT = Template("E-BLK-080", "the server at {at} has not answered for {wait:g} s")
CONNECTION_LOST = Template("E-BLK-082", "the connection to {at} is lost: {reason}")

# -- code of one name ------------------------------------------------------------------------------------

OWN_PROCESS = Template("N-BLK-083", "{name} runs in a process of its own: its {what} differs from that of {other}")
HIDDEN_MODULE = Template(
    "W-BLK-085",
    "{file} does not get its own module {module}, since its process has loaded {other}; rename the module in the FMU",
)
HIDDEN_LIBRARY = Template(
    "W-BLK-086",
    "{file} brings {library}, but its process has already loaded another one, {other}, which the FMU therefore uses; "
    "rename the FMU's library, or link it statically",
)
