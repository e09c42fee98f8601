"""Messages of experiments."""

from cosim.base.messages import Template

NONE_WITHIN_LIMITS = Template(
    "E-EXP-001",
    "none of {count} experiments stays within the limits; widen --limit or shorten --duration",
)
NONE_SEPARATES = Template(
    "E-EXP-002",
    "none of {count} experiments drives any two rivals a standard deviation apart; "
    "try a wider --limit, a longer --duration or more outputs --measured",
)
DURATION_OUT_OF_RANGE = Template(
    "E-EXP-003",
    "--duration {duration:g}: an experiment lasts between {shortest:g} and {longest:g} s for a step of {step:g} s",
)
NO_STATES = Template(
    "E-EXP-004",
    "{model} has no states, so an input over time adds no information; told_apart_by of the model names rows that "
    "separate its rivals",
)
UNKNOWN_OUTPUT = Template("E-EXP-005", '--measured: no output "{name}"{cure}')
NOTHING_MEASURED = Template(
    "E-EXP-006", "the model does not state the measured outputs; add --measured NAME, one of {outputs}"
)
NO_STUDY = Template(
    "E-EXP-007", "no such study: {study}; a relative path starts from the current folder, so run the command there"
)
UNKNOWN_CANDIDATE = Template("E-EXP-008", 'no candidate "{name}"{cure}')
REPEATED_CANDIDATE = Template("E-EXP-009", '"{name}" is named twice; name it once')
NO_LIMIT = Template(
    "E-EXP-010",
    "how far from {start:g} may {name} go? Say --limit {name}=VALUE or --range {name}=MIN..MAX [{unit}]",
)
LIMIT_OF_UNKNOWN_SIGNAL = Template("E-EXP-011", '--limit {text}: no input or output "{name}"{cure}')
LIMIT_NOT_A_DISTANCE = Template(
    "E-EXP-012", "--limit {text}: say how far {name} may go, above 0 [{unit}], such as {name}=0.1"
)
RANGE_OF_UNKNOWN_INPUT = Template("E-EXP-013", '--range {text}: no input "{name}"{cure} (inputs: {inputs})')
RANGE_NOT_AN_INTERVAL = Template(
    "E-EXP-014", "--range {text}: say between what {name} stays, lower end first [{unit}], as {name}=0..10"
)
RANGE_OUTSIDE_BOUNDS = Template(
    "E-EXP-015", "--range {text}: the model declares {low:g}..{high:g} {unit} of {name}; choose a range that overlaps"
)
INSEPARABLE_RIVALS = Template(
    "W-EXP-016",
    "the best input does not tell {pairs} (less than {needed:g} standard deviations apart); "
    "try a wider --limit, a longer --duration or more outputs --measured",
)
USUAL_INPUT_IS_BETTER = Template(
    "W-EXP-017",
    "{usual} separates better ({count} of {pairs}, the nearest {distance:.1f} standard deviations apart) "
    "but goes {excess:.1f} times as far as --limit allows",
)
NO_RIVALS = Template("E-EXP-018", "has no terms that are hard to separate; name rivals as --against ({names})")
