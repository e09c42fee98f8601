"""Messages of the command line."""

from cosim.base.messages import Template

# Every command
NO_MEMORY = Template("E-CLI-001", "there is not enough memory; run shorter, in longer steps or with less recorded")
DISK_FULL = Template("E-CLI-002", "{file}the disk is full")
FILE_ERROR = Template("E-CLI-003", "{file}{reason}")
CRITERIA_MISSED = Template("E-CLI-005", "{missed} of {count} criteria missed{criteria}")
NO_BROWSER = Template("W-CLI-006", "no browser is found here; open {page}")
VERB_EXISTS = Template("W-CLI-007", "{name}: an installed package registers a verb that cosim has; it is ignored")
WRONG_USAGE = Template("E-CLI-018", "{reason}")
NO_ANSWER = Template("E-CLI-019", "the input ended at a prompt; run it on a terminal")

# Single commands
ALIKE_FINDINGS = Template("N-CLI-053", "… and {count} more like the last one; --json lists all of them")
NATIVE_ONLY = Template("E-CLI-008", "is of native FMUs; add --native, or leave it out")
COMPILE_WITHOUT_LOAD = Template(
    "E-CLI-009", "is to load FMUs, which --no-load (in Python load=False) forbids; leave one of them out"
)
NOTHING_TO_CHECK = Template("E-CLI-010", "is {kind}, in which there is nothing to check: {cure}")
NO_SPACE_TO_LOAD = Template("E-CLI-011", "the disk is full, so that no FMU can be tried; --no-load checks without")
NOT_EXECUTED = Template("W-CLI-012", "{code} (--no-load); that file and everything that depends on it are not checked")
NOT_A_DIAGRAM_FILE = Template("E-CLI-013", "name an .svg or .mmd file")
NO_FOLDER = Template("E-CLI-014", "its folder is not there; make it first")
KEYS_OF_STUDY = Template(
    "E-CLI-015",
    "logs, validation and settings stand in the file; write them into the study, or give an object in its place",
)
NOT_JSON = Template("E-CLI-016", "holds what no file can: {reason}")
NO_SCHEMA = Template("E-CLI-017", "is no kind of file that has a schema; give one of {kinds}")
SEVERAL_RUNS = Template("E-CLI-050", "{count} runs match; give a list to compare them all")
NO_RUN = Template("E-CLI-054", "no run is given; name at least two runs to compare")
ONE_RUN = Template("E-CLI-051", "is one run; name at least two runs to compare")
SEVERAL_BASELINES = Template("E-CLI-052", "{count} runs match; name one as the baseline")
