"""Messages of the signal browser."""

from cosim.base.messages import Template

OTHER_QUANTITY = Template(
    "E-VIE-018",
    "{text0} is in {unit0} and {text1} in {unit1}, which measure different quantities; write number({text1}) for its "
    "number without unit",
)
NO_ARGUMENT = Template(
    "E-VIE-019",
    "{text0} is in {unit0}; this function takes an angle, a ratio, or a time in seconds; write number({text0}) for its "
    "number without unit",
)
NO_ROOT = Template(
    "E-VIE-020",
    "{text0} is in {unit0}, which has no power {exponent}; write number({text0}) for its number without unit",
)
UNIT_WITH_POWERS = Template(
    "E-VIE-021",
    "{text0} is in {unit0}, and its exponent {exponent} is no number; write number({text0}) for its number "
    "without unit",
)
NO_TEMPERATURE = Template(
    "E-VIE-022",
    "{text0} in {unit0} is a sum or a multiple of temperatures, but no temperature; take a mean, a difference, or "
    "number(…) of each part",
)
