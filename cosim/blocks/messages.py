"""Messages of components: FMUs, sources and faults."""

from cosim.base.messages import Template

# -- reading an FMU --------------------------------------------------------------------------------

NO_ARCHIVE = Template("E-BLK-001", "{file} is no FMU: {error}")
UNREADABLE_FILE = Template("E-BLK-002", "{file} cannot be read: {reason}")
INVALID_FMU = Template("E-BLK-003", "{file} is not a valid FMU: {error}")
INVALID_NUMBER = Template("E-BLK-004", '{file} is not a valid FMU: {place} is "{value}", which is no number')
INVALID_WHOLE_NUMBER = Template(
    "E-BLK-005", '{file} is not a valid FMU: {place} is "{value}", which is no whole number'
)
ARRAY_TOO_LARGE = Template(
    "E-BLK-006", "{file} is not a valid FMU: its array {variable} is {size}, not 0 … {limit:g} elements"
)
MESSAGES_LEFT_OUT = Template(
    "W-BLK-111",
    "{count:,} messages are left out here: the first {first} and the last {last} are recorded",
)
NO_GUID = Template(
    "E-BLK-110",
    "{file} is not a valid FMU: its modelDescription.xml has no {attribute}, which its library compares when it is "
    "loaded; export the FMU again, or ask the tool that made it",
)
UNSUPPORTED_INTERFACE = Template(
    "E-BLK-007",
    "{file} is {interface}; FMI 1.0, 2.0 and 3.0 for co-simulation or model exchange, and 3.0 for scheduled "
    "execution, are run here",
)

SCHEDULED_ONLY = Template(
    "E-BLK-070", "{file} is for scheduled execution, which a scenario runs (components: {{name: {{fmu: FILE}}}})"
)

# -- loading its library ---------------------------------------------------------------------------

NOT_LOADED = Template("E-BLK-008", "{file} does not load: {error}")
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
MISNAMED_LIBRARIES = Template("E-BLK-013", "none of its libraries is {name}, as its modelIdentifier says: {libraries}")
MISNAMED_LIBRARY = Template("W-BLK-014", "its library is {name}, its modelIdentifier {identifier}")
NO_SPACE_TO_UNPACK = Template(
    "E-BLK-015", "the disk is full: no room to unpack {file} in the folder for temporary files (TMPDIR)"
)
UNREADABLE_LIBRARY = Template("E-BLK-016", "its library {library}: cannot be read: {reason}")
GIT_LFS_POINTER = Template(
    "E-BLK-017",
    'its library {library}: is a pointer of git-lfs, not the file itself; "git lfs pull" in its repository brings it',
)
OTHER_SYSTEM = Template(
    "E-BLK-018",
    "its library {library}: is made for {system}, though its folder is that of Linux; export the FMU for this platform",
)
NOT_A_LIBRARY = Template(
    "E-BLK-019", "its library {library}: is no library (it begins with {head}); export the FMU for this platform"
)
OTHER_WORD_SIZE = Template(
    "E-BLK-020",
    "its library {library}: has {bits} bits (wrong ELF class), this Python {own}; export the FMU for this platform",
)
OTHER_PROCESSOR = Template(
    "E-BLK-021",
    "its library {library}: is made for {processor}, this machine is {own}; export the FMU for this platform",
)
MISSING_DEPENDENCY = Template(
    "E-BLK-022",
    "its library {library}: needs {file}, which is not on this machine ({reason}); install the package that has "
    "{file}, or name its folder in LD_LIBRARY_PATH",
)
OLD_SYSTEM = Template(
    "E-BLK-023",
    "its library {library}: needs {name} {version}{own} ({reason}); run it on a newer system, or have the FMU built on "
    "an older one",
)
MISSING_FUNCTION = Template(
    "E-BLK-024",
    "its library {library}: has no function {function}, which FMI demands ({reason}); export the FMU for this platform "
    "with a tool that writes it",
)
MISSING_SYMBOL = Template(
    "E-BLK-025",
    "its library {library}: needs {symbol}, which no library that it names has ({reason}); the FMU was linked without "
    "the library that has it: export it again, with that library",
)
FOLDER_NOT_EXECUTABLE = Template(
    "E-BLK-026",
    "its library {library}: may not be executed where FMUs are unpacked ({reason}); set TMPDIR to a folder in which "
    "programs may be executed (not mounted noexec)",
)
LOADER_ERROR = Template("E-BLK-027", "its library {library}: {reason}")

# -- compiling its sources -------------------------------------------------------------------------

NO_COMPILER = Template("E-BLK-028", "its sources cannot be compiled: {error}")
COMPILER_ERROR = Template("E-BLK-029", "its sources do not compile: {error}{output}")
SOURCE_OUTSIDE = Template("E-BLK-030", 'its sources cannot be compiled: "{name}" lies outside its folder')
MISSING_SOURCES = Template(
    "E-BLK-031",
    "its sources cannot be compiled: it lists {names}, which is not there; export it again with all its sources",
)
NO_SOURCES = Template(
    "E-BLK-032",
    "its sources cannot be compiled: it has no C or C++ file in its folder `sources`; export it again with its sources",
)
UNKNOWN_LANGUAGE = Template(
    "E-BLK-033", "its sources cannot be compiled: they are in {language}; known are {languages}"
)

# -- calling it ------------------------------------------------------------------------------------

CALL_FAILED = Template("E-BLK-034", "{function} returned {status}")
CALL_FAILED_WITH_REASON = Template("E-BLK-035", "{function} returned {status}: {reason}")
CALL_WARNING = Template("W-BLK-036", "{function} returned Warning")
END_BY_DISCARD = Template("N-BLK-037", "{function} returned Discard: the FMU ended the simulation early")
END_BY_DISCARD_WITH_REASON = Template(
    "N-BLK-038", "{function} returned Discard: the FMU ended the simulation early: {reason}"
)
END_BY_FMU = Template("N-BLK-039", "the FMU ended the simulation")
INPUT_UNFIT = Template(
    "E-BLK-040", "the input {reason}, the range of its type; scale or limit the value connected to it"
)
VALUE_NOT_FINITE = Template(
    "E-BLK-041",
    "the value is {value}, which is no finite number; check the component's inputs and parameters, or take a "
    "shorter step",
)
SCHEMA_VIOLATION = Template(
    "W-BLK-042", "{file} breaks a rule of the FMI standard: {violation}{more}; it is used nevertheless"
)
UNSUPPORTED_TYPES = Template(
    "W-BLK-043", "variables of type {types} are not supported: they are neither set nor recorded"
)

# -- integrating its derivatives -------------------------------------------------------------------

STEP_TOO_SHORT = Template(
    "E-BLK-044", "a step of {step:.3g} s is too short at this time: doubles are {spacing:.2g} s apart there"
)
CHATTERING = Template("E-BLK-045", "it chatters: {count} events within {span:.2g} s, so that time stands still")
EVENTS_NOT_SEPARATED = Template(
    "E-BLK-083",
    "its events follow each other within {span:.2g} s, too fast for the solver to separate them: event "
    "indicator {number} crosses zero and returns ever faster, like a ball before it rests. The FMU needs a mode in "
    "which it rests. A smaller tolerance separates more events; an end of the run before this time avoids them",
)
RESTLESS_STATES = Template("E-BLK-046", "its discrete states still change after {count} updates")
PAST_EVENT = Template(
    "E-BLK-047",
    "{count} times in a row it gives t = {time:.6g} s as the time of its next event, which is not in the future; "
    "the FMU must give a later time or none",
)
DERIVATIVE_NOT_FINITE = Template(
    "E-BLK-048",
    "the derivative {name} is {value}, also with the shortest steps of the solver. If the solution is finite, its "
    "error grew: make `tolerance` smaller than the smallest state, or use solver: solve_ivp",
)
TOO_MANY_SOLVER_STEPS = Template(
    "E-BLK-049",
    "{solver} does not reach the next communication point in {count} steps of its own. Allow more (max_steps), shorten "
    "the step{other}, or check whether a state grows without bound",
)
TOLERANCE_TOO_TIGHT = Template(
    "E-BLK-050", "CVODE cannot reach the tolerance, as doubles are not that exact; loosen it"
)
NO_STEP_WITHIN_TOLERANCE = Template(
    "E-BLK-051",
    "{solver} finds no step so short that its error is within the tolerance; a derivative jumps, or has no bound",
)
NO_CONVERGENT_STEP = Template(
    "E-BLK-052",
    "CVODE finds no step so short that its iteration converges; a derivative jumps, or has no bound",
)
SPAN_TOO_SHORT = Template("E-BLK-053", "CVODE is to integrate over less time than doubles tell apart")
CVODE_FAILED = Template("E-BLK-054", "CVODE failed")
CVODE_FAILED_WITH_REASON = Template("E-BLK-055", "CVODE failed (code {number}): {reason}")
SOLVE_IVP_FAILED = Template("E-BLK-056", "solve_ivp: {reason}")
RATES_NOT_FINITE = Template(
    "E-BLK-057", "its derivatives or outputs are not finite at these states and inputs; choose another operating point"
)
SLOPES_NOT_FINITE = Template(
    "E-BLK-058",
    "the slopes of its derivatives or outputs are not finite at these states and inputs; choose another operating "
    "point",
)

# -- event mode and clocks ---------------------------------------------------------------------------

BAD_INTERVAL = Template(
    "E-BLK-071", "its interval is {interval:g} s; a periodic clock needs one above 0, another clock one of 0 or more"
)
TWICE_AT_ONCE = Template(
    "W-BLK-072",
    "clock {clock} was due twice at t = {time:.6g} s; FMI allows one activation at a time, so one is left out",
)

# -- FMUs on other machines ----------------------------------------------------------------------------

KEYS_MISSING = Template(
    "E-BLK-074",
    "{at} is another machine, or keys are given in part: {server} must name the file of the server's public key, "
    "{client} the file of your secret key (cosim serve --new-key NAME makes both)",
)
NO_KEY_FILE = Template("E-BLK-075", "{file} is no key file: {reason}; cosim serve --new-key NAME makes one")
OPEN_KEY = Template("E-BLK-076", "{file} is a secret key that others may read; chmod 600 {file}")
UNREACHABLE = Template("E-BLK-077", "no server answers at {at}; start one there: cosim serve FOLDER --port PORT")
UNUSABLE_ADDRESS = Template("E-BLK-078", "{at} cannot be used: {reason}")
HANDSHAKE_FAILED = Template(
    "E-BLK-079",
    "what listens at {at} refuses the connection: it is no server of cosim, or the keys here (COSIM_SERVER_KEY, "
    "COSIM_CLIENT_KEY) and there do not match",
)
SERVER_SILENT = Template("E-BLK-080", "the server at {at} has not answered for {wait:g} s")
OTHER_VERSION = Template(
    "E-BLK-081",
    "the server at {at} has version {there} of the protocol, this side version {here}; install the same cosim on both",
)
CONNECTION_LOST = Template("E-BLK-082", "the connection to {at} is lost: {reason}")

# -- code of one name ------------------------------------------------------------------------------------

OWN_PROCESS = Template("N-BLK-083", "{name} runs in a process of its own: its {what} differs from that of {other}")
SHARED_CODE = Template(
    "E-BLK-084",
    "{file} does not load: its {what} differs from that of {other}, which this process has loaded; run it in a worker "
    "process (without in_process, --in-process)",
)
HIDDEN_MODULE = Template(
    "W-BLK-085",
    "{file} does not get its own module {module}, since its process has loaded {other}; rename the module in the FMU",
)
HIDDEN_LIBRARY = Template(
    "W-BLK-086",
    "{file} brings {library}, but its process has already loaded another one, {other}, which the FMU therefore uses; "
    "rename the FMU's library, or link it statically",
)
ASSUMED_WITHOUT_FEEDTHROUGH = Template(
    "W-CPL-001",
    "{component} does not declare which outputs depend directly on its inputs; cosim assumes that none does, so "
    "{component} steps first. feedthrough: [...] of {component} names the inputs that an output follows at once, [] "
    "for none; order: [...] states the order instead",
)
