"""Messages of models and their files."""

from cosim.base.messages import Template

# -- the choice of a model

NO_SUCH_MODEL = Template("E-LOD-001", "no such model: {name}; {allowed}")
NO_CLASS_NAMED = Template("E-LOD-002", "names no class: write {name}:{kind}; {allowed}")
NO_SUCH_FILE = Template("E-LOD-003", "no such file; {allowed}")
NO_MODEL_FILE = Template("E-LOD-004", "no such model file; check the path")
UNKNOWN_CLASS = Template("E-LOD-005", 'has no model class "{name}"{cure}{classes}; {allowed}')
NO_MODEL_CLASS = Template("E-LOD-006", "has no model class; {allowed}")
SEVERAL_CLASSES = Template("E-LOD-007", "has {count} models; write {choice}")
STUDY_FOR_MODEL = Template(
    "E-LOD-008",
    "this is a study, not a model: give its model, {model}, or, to `cosim excite`, the folder that `cosim refine` left",
)
NEAREST_WITHOUT_MODEL = Template(
    "E-LOD-009", "has no effect without a model; give the folder of a `cosim refine` as --model, or leave --nearest out"
)
NO_REFINE = Template(
    "E-LOD-010",
    "{path} is of no refine, so there is no nearest model; name the folder that `cosim refine` left, or leave nearest "
    "out",
)
NO_NEAREST = Template("E-LOD-011", "{folder} holds no {name}; refine its study again, or leave nearest out")

# -- model.yaml

UNKNOWN_MODEL = Template("E-LOD-012", 'no model "{name}"{cure}; {allowed}')
NO_CLASS_FILE = Template("E-LOD-013", "no such file: {file}; {allowed}")
UNKNOWN_NAME = Template("E-LOD-014", '{model} has no {kind} "{name}"{cure}')
UNSUITABLE_VALUE = Template("E-LOD-015", "{owner}{fault}; correct this value")
NO_PARAMETERS_FILE = Template("E-LOD-016", "no such model file: {name}; name a model.yaml or the folder of a refine")
PARAMETERS_IN_CIRCLE = Template("E-LOD-017", "{name} takes its parameters from here itself; leave one of them out")
UNSUITABLE_FOREIGN_VALUE = Template("E-LOD-018", "{name}: {fault}; correct it there, or write it under parameters")
NO_COMMON_PARAMETER = Template("E-LOD-019", "{name} holds no parameter that {model} has; leave it out")

# -- a model's Python

FORMER_IMPORT = Template(
    "E-LOD-020",
    "`plant` is not a part of the modelling language any more; write `from cosim.model import {names}` in place of "
    "`from plant.…`",
)
EXCEPTION = Template("E-LOD-021", "{doing}: {error}")
TRUTH_OF_SYMBOL = Template(
    "E-LOD-022",
    "{doing}: {error}; no `if`, `max`, `min` or `and` on a number: m.where(condition, then, otherwise) works on "
    "symbols too",
)
FOREIGN_FUNCTION = Template("E-LOD-023", "{doing}: {error}; functions come from m, which has {functions}")

# -- declarations of a class

NO_EQUATIONS = Template(
    "E-LOD-024", "{owner} has no equations; give it `def equations(self, m)` that returns Equations"
)
NO_QUANTITIES = Template("E-LOD-025", '{owner} has no {name}; add {name} = (Quantity("name", "unit", "meaning"),)')
NOT_QUANTITIES = Template("E-LOD-026", "{name} is a tuple of quantities, with a comma even after a single one")
NOT_SUBCLASSES = Template(
    "E-LOD-027", "{name} is a tuple of subclasses of {base}, with a comma even after a single one"
)
NOT_NAMES = Template("E-LOD-028", '{name} is a tuple of names, with a comma even after a single one: ("name",)')
NOT_VALIDITIES = Template(
    "E-LOD-029", 'valid is a tuple: (Validity("quantity", ("input",), low, high, "what happens beyond"),)'
)
NOT_MAPPING = Template("E-LOD-030", "{name} is a dictionary: {form}")
NO_LABEL = Template("E-LOD-031", '{owner} has no {name}; add {name} = "…"')
DOT_IN_NAME = Template("E-LOD-032", 'the name "{name}" has a dot, which parts effect and parameter; leave it out')
NO_FIELD = Template(
    "E-LOD-033", "{owner}.{name} is no field: put @dataclass(frozen=True, kw_only=True) above the class"
)
BOUNDS_OUT_OF_ORDER = Template("E-LOD-034", "{name} has bounds {bounds}; write the lower one first")
UNSUITABLE_DEFAULT = Template("E-LOD-035", "the {word} of {owner}{fault}; change the value or the bounds")
UNSUITABLE_TOLERANCE = Template(
    "E-LOD-036", "the tolerance of {name} is {value!r}; it is a share of the value, as 0.1 for 10 %"
)
UNSUITABLE_TYPICAL = Template("E-LOD-037", "the typical of {name} is {value!r}; it is a size above 0")
NOT_A_TIME = Template("E-LOD-038", "{name} is {value!r}; it is a time above 0 s")
UNKNOWN_INTEGRATOR = Template("E-LOD-039", "integrator is {value!r}; it is one of {names}")
NOT_POSITIVE = Template("E-LOD-040", "the {attribute} of {name} is {value!r}; it is a number above 0")
START_OUT_OF_BOUNDS = Template("E-LOD-041", "{name} starts at {start:g}, beyond its bounds {bounds}")
NEVER_AWAKE = Template(
    "E-LOD-042", "{owner} has no parameter with a neutral value, so that it can never be awake; add one"
)
AWAKE_BY_DEFAULT = Template(
    "E-LOD-043", "the default of {owner}.{name} is {default!r}, its neutral value {neutral!r}; let them be the same"
)
UNKNOWN_PARAMETER = Template("E-LOD-044", '{owner} has no parameter "{name}"{cure}')
READ_OF_SEVERAL_OUTPUTS = Template(
    "E-LOD-045",
    "{owner}: `read` returns one output, but the class declares several `outputs`; declare one `output` instead, "
    "or define `readings`",
)
NAMES_NO_TUPLE = Template(
    "E-LOD-046", '{owner}: {attribute} is a tuple of names, with a comma even after a single one: ("{value}",)'
)
UNKNOWN_SIGNAL = Template("E-LOD-047", '{owner}: no {kind} "{name}"{cure}{place} ({kind}s: {names})')
NO_SIGNAL_NAMED = Template("E-LOD-048", "{owner}: no {kind} is named{place} ({kind}s: {names})")
PARAMETERS_OF_SENSOR = Template(
    "E-LOD-049", 'a sensor error has one parameter, called "value"; {owner} has {names}; {cure}'
)
DELAY_WITHOUT_SHAPE = Template("E-LOD-050", "{owner} delays the command but has no `shape`; give it one")
DELAY_NOT_FIRST = Template("E-LOD-051", "{owner} delays the command: put it before {first} in the catalogue")
MEMORY_OF_DELAY = Template(
    "E-LOD-052",
    "{owner} delays {inputs} inputs and has {memory} quantities of memory; give it one for each input, in their order",
)
SEVERAL_DELAYS = Template("E-LOD-053", "{owner} and {other} both delay the command; let one of them do it")
UNKNOWN_DELAY = Template(
    "E-LOD-054", '{owner} has no parameter "{name}"{cure}; `delay` names the one by which the command is late'
)
SHORT_MEMORY = Template(
    "E-LOD-055", "{owner} is up to {delay:g} s late and remembers {longest:g} s; set longest = {delay:g}"
)
MEMORY_WITHOUT_STATES = Template(
    "E-LOD-056",
    "{model} has no states, so each row of its tables is independent of the others; {owner} keeps what was before: "
    "leave it out, or give the model a state",
)
SHAPE_WITHOUT_STATES = Template(
    "E-LOD-057",
    "{model} has no states, and {owner} shapes what acts on states: an output takes a command unchanged; let it act in "
    "the output, by a hook of your own",
)
DRIFT_WITHOUT_STATES = Template(
    "E-LOD-058",
    "{model} has no states, so each row of its tables is independent of the others; {owner} depends on time: leave it "
    "out, or give the model a state",
)
TIME_WITHOUT_STATES = Template(
    "E-LOD-059",
    "{model} has no states, so each row of its tables is independent of the others; let no output depend on time",
)
UNKNOWN_UNIT = Template(
    "E-LOD-060",
    'unknown unit "{unit}" of {name}; write it with SI symbols, as in N.m.s/rad or m/s2, and a pure number as 1',
)

# -- names of a class

DUPLICATE_NAME = Template("E-LOD-061", '{attribute} has {count} called "{name}"; give each its own name')
SIGNAL_CALLED_TIME = Template(
    "E-LOD-062",
    'an input or output is called "time", which is the first column of a log; give it another name',
)
DUPLICATE_EFFECT = Template("E-LOD-063", '{count} effects or sensor errors are called "{name}"; give each its own name')
EFFECT_CALLED_AS_PARAMETER = Template(
    "E-LOD-064", '"{name}" is a parameter of the model too; give the effect another name'
)
DUPLICATE_VARIABLE = Template(
    "E-LOD-065",
    '{count} of its inputs, outputs, parameters and start values ("state_start") are called "{name}"; give each its '
    "own name",
)
NO_PLANAR_FRAME = Template("E-LOD-066", "planar is a PlanarFrame({fields}) of outputs, or None")
NO_FORCED_STATE = Template(
    "E-LOD-067",
    "forced names no state; name those whose equations may lack something, the accelerations usually (states: {names})",
)
UNKNOWN_REFERENCE = Template("E-LOD-068", '{attribute}: no {kind} "{name}"{cure} ({kinds}: {names})')
SUSPECT_AND_CALIBRATED = Template("E-LOD-069", '"{name}" is in calibrated too; leave it out of suspect')

# -- trial of the equations

NO_DICTIONARY = Template("E-LOD-070", "`{hook}` gives {value!r}; return a dictionary of values by name")
START_OF_STRANGER = Template("E-LOD-071", '`{hook}` gives a value for "{name}"{cure} (allowed: {names})')
NO_EQUATIONS_RETURNED = Template("E-LOD-072", "`equations` gives {kind}; return Equations(derivative, output)")
NO_TUPLE = Template("E-LOD-073", "`{function}` gives one {kind}; return a tuple of {count}: {names}")
NUMBER_OF_VALUES = Template("E-LOD-074", "`{function}` gives {count} values; return {expected}: {names}")
UNSUITABLE_RESULT = Template("E-LOD-075", "`{function}` gives {text} for {name}")
RESULT_OF_SHAPE = Template(
    "E-LOD-076", "`shape` of {owner} returns two tuples: {commands} commands and {memory} of memory"
)
OUTPUTS_OF_READINGS = Template("E-LOD-077", "`{hook}` of {owner} reads {names}; it is of {outputs}")
UNSUITABLE_READING = Template("E-LOD-078", "`{hook}` of {owner} gives {text} for a reading; return a number")

# -- integrator and substep

UNSTABLE_SUBSTEP = Template(
    "E-LOD-079",
    "substep is {substep}, unstable for this model: {mode}, and RK4 in steps of {step} lets it grow; state at most "
    "{longest}, or leave substep out: then it follows the model",
)
GROWING_MODE = Template(
    "E-LOD-080",
    "{model} runs away: {mode} that grows; check its parameters, start values and the units of the log",
)
STIFF_MODEL = Template(
    "E-LOD-081",
    "{model} is stiff: {mode}, for which RK4 takes more than {most} substeps in a rate of {rate}; let {state} follow "
    "the rest at once, as an algebraic equation, or state a substep of at most {longest} and take the time that it "
    "costs",
)
STIFF_MODEL_WITH_RK4 = Template(
    "E-LOD-082",
    "{model} is stiff: {mode}, for which RK4 takes more than {most} substeps in a rate of {rate}; state integrator = "
    "'stiff', or leave it out",
)
IMPLICIT_METHOD = Template(
    "N-LOD-083", "integrated by the implicit method, in substeps of {substep}, not by RK4: {mode}"
)
SHORTER_SUBSTEP = Template("N-LOD-084", "integrated in substeps of {substep}, not of the default {default}: {mode}")

# -- native FMUs

FMI_VERSION = Template("E-LOD-085", "is {version}; it is {versions}")
NOT_PRINTABLE = Template("E-LOD-086", "cannot be printed as C: {error}; {cure}")
COMPILER_FAILED = Template("E-LOD-087", "the compiler {error}; mend the compiler, or name another in CC")
UNKNOWN_PLATFORM = Template("E-LOD-088", 'no platform "{name}"{cure} (known: {names})')
NO_TERM_CLASS = Template(
    "E-LOD-089", "holds no term; a term is a subclass of cosim.terms.Force, InputTerm or RateTerm with a kind"
)
