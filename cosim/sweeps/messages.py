"""Messages of sweeps."""

from cosim.base.messages import Template

TOO_MANY_RUNS = Template(
    "E-SWP-001", "{runs:.3g} runs are more than the {limit:,} that a sweep may have; give fewer values or runs"
)
SALTELLI_WITH_LISTED_VALUES = Template(
    "E-SWP-002",
    "saltelli takes only distributions, no listed values; vary by distributions, or choose another sampling",
)
TOO_FEW_RUNS_FOR_SALTELLI = Template(
    "E-SWP-003", "{runs} runs are too few: with {factors} distributions saltelli needs {least} runs at least"
)
WAY_FOR_SEEDS = Template("E-SWP-004", "{way} is for `seed` only; give values, a grid or a distribution")
SEEDS_NOT_WHOLE = Template(
    "E-SWP-005", "seeds are whole numbers that are not negative: values: [1, 2], count: 20 or each: 1"
)
NO_START_VALUES = Template(
    "E-SWP-006",
    "{component} is no FMU and has no start values; vary a path such as components.{component}.… by values",
)
UNKNOWN_VARIABLE = Template("E-SWP-007", '{component} has no variable "{name}"{hint}')
NO_START_VALUE = Template("E-SWP-008", "{name} is {kind}; it takes no start value")
ARRAY_VARIABLE = Template("E-SWP-009", "is an array; vary a path of the scenario by values")
CONNECTED_INPUT = Template("E-SWP-010", "is an input that is connected; vary what feeds it")
VALUE_NOT_ALLOWED = Template("E-SWP-011", "{name} is {value}; {reason}")
UNKNOWN_FACTOR = Template("E-SWP-012", 'no component and no key of the scenario is "{name}"{hint}')
SAME_FOR_ALL_RUNS = Template("E-SWP-013", "{key} is one for all runs; give it by `set`")
NOT_A_NUMBER = Template("E-SWP-014", "{name} is {value}; it is a number")
NOT_REAL = Template("E-SWP-015", "{name} is no real number; give its values as a list, values: […]")
UNKNOWN_SIGNAL = Template("E-SWP-016", 'no signal "{name}"{hint}')
DRAWN_VALUE_NOT_ALLOWED = Template("E-SWP-017", "{name} would be {value:g}: {reason}; {cure}")
STANDARD_DEVIATION_NOT_POSITIVE = Template(
    "E-SWP-018", "a standard deviation of {value:g} is not allowed; give one above 0"
)
EMPTY_RANGE = Template(
    "E-SWP-019", "between {low:g} and {high:g} there is nothing; write the lower end first, the higher one second"
)
RANGE_OUTSIDE_DISTRIBUTION = Template(
    "E-SWP-020", "within {low:g} … {high:g} there is nothing of the distribution; move its ends"
)
MODE_OUTSIDE_RANGE = Template(
    "E-SWP-021", "the most likely value, {value:g}, is not between {low:g} and {high:g}; write low, most likely, high"
)
NO_LOGARITHM = Template("E-SWP-022", "{value:g} has no logarithm; give ends above 0")
VARIED_TWICE = Template("E-SWP-023", '{entry} and "{other}" of line {line}: both give {place}; vary one of them')
WHOLE_AFTER_PART = Template(
    "E-SWP-024",
    '{entry} and "{other}" of line {line} both set {place}, and the later entry replaces the earlier one; set the '
    "whole first and its part after it",
)
SET_AND_VARIED = Template(
    "E-SWP-025",
    '{entry} and "{other}" of line {line} both set {place}, and the varied value replaces this one; remove this one',
)
START_VALUE_OF_DESIGN = Template(
    "E-SWP-026",
    '{entry} and "{other}" of line {line} both give one start value, and that of the component replaces that of '
    "the design; keep one of them",
)
NO_SCENARIO = Template("E-SWP-027", "no such scenario: {name}")
DATABASE_NOT_A_FILE = Template("E-SWP-028", "is no file of a sweep; move it away, or give another --out")
DAMAGED_DATABASE = Template("E-SWP-029", "is no database of a sweep: {reason}; --force begins anew")
RUNS_OF_ANOTHER_SWEEP = Template(
    "E-SWP-030", "holds the runs of another sweep; give another folder as --out, or begin anew by --force"
)
TABLE_OF_ANOTHER_SWEEP = Template(
    "E-SWP-031",
    "holds another sweep, or one of other FMUs; give another folder as --out, or begin anew by --force",
)
NO_DASK_SCHEDULER = Template(
    "E-SWP-032",
    "no dask scheduler answers at {address} within {time} s ({reason}); start one by `dask scheduler`",
)
NO_DASK_WORKERS = Template(
    "E-SWP-033", "the dask scheduler at {address} has no workers; start some by `dask worker {address}`"
)
UNFIT_DASK_WORKERS = Template(
    "E-SWP-034",
    "the dask scheduler at {address} has {workers} of {count} without cosim {version} ({worker}: {reason}); install"
    " cosim {version} where they run, or start them in the environment of this command",
)
DASK_WORKER_FAILED = Template(
    "E-SWP-035",
    "a dask worker failed: {reason}; see the log of the worker; the same command goes on with the runs that are there",
)
STOPPED = Template("E-SWP-036", "stopped: {stored} of {runs} are kept in {path}; the same command goes on with them")
DISK_FULL = Template(
    "E-SWP-046",
    "the disk is full: {stored} of {runs} are kept in {path}; make room, and the same command goes on with them",
)
NO_RUN_COMPLETED = Template("E-SWP-037", "all {runs} failed; run 0: {error}")
ARRAYS_DISAGREE = Template(
    "W-SWP-038",
    "{runs} repeated through the FMUs do not agree: the largest relative difference is {difference}; {allowed} is"
    " allowed",
)
TOO_FEW_RUNS = Template("W-SWP-039", "Too few runs for sensitivities: {completed} completed, {least} are needed.")
WIDE_INTERVALS = Template(
    "W-SWP-040",
    "Too few runs to rank the factors of {outcome}: intervals of its indices reach ±{width}. Take more runs.",
)
ARRAYS_AGREE = Template(
    "N-SWP-041",
    "{runs} repeated through the FMUs agree: the largest relative difference is {difference}; {allowed} is allowed",
)
ALL_THROUGH_FMUS = Template("N-SWP-042", "every run was made through the FMUs{reason}")
ENDED_EARLY = Template("E-SWP-044", "it ended at t = {time:g} s")
NOT_COMPARED = Template(
    "W-SWP-045", "this sweep does not record whether its runs were repeated through the FMUs; --force begins anew"
)
NO_PANDAS = Template("E-SWP-043", "to_pandas needs pandas: pip install pandas")
