"""Messages of logs."""

from cosim.base.messages import Template

# -- columns --------------------------------------------------------------------------------------


# -- clock ----------------------------------------------------------------------------------------

_JITTER = (
    "rows are {step} apart, give or take {spread} (at most {worst}); "
    "replays step at their times, the filter of `cosim refine` at equal ones"
)
STRONG_JITTER = Template("W-LOG-021", _JITTER)
JITTER = Template("N-LOG-022", _JITTER)

# -- inputs and outputs ---------------------------------------------------------------------------


# -- units and signs ------------------------------------------------------------------------------

_OPPOSITE_RATE = (
    "has the opposite sign of d {name}/dt (slope {slope}); "
    "turn one of them round: the rate is positive where the signal grows"
)
OPPOSITE_RATE = Template("E-LOG-041", _OPPOSITE_RATE)
OPPOSITE_RATE_BY_NAME = Template("W-LOG-042", _OPPOSITE_RATE)
_DEGREES = "is {factor} times what {other} says: one is in degrees, the other in radians. {cure}"
DEGREES = Template("E-LOG-043", _DEGREES)
DEGREES_BY_NAME = Template("W-LOG-044", _DEGREES)

_OTHER_SIZE = 'is its unit {unit}? Then call the column "{name} [{unit}]"'
_OTHER_SLOPE = "moves with the model, but {slope} ± {error} times as far; " + _OTHER_SIZE
OTHER_SLOPE = Template("E-LOG-062", _OTHER_SLOPE)
PERHAPS_OTHER_SLOPE = Template("W-LOG-060", _OTHER_SLOPE)
_CONVERTED_UNIT = (
    "was converted from {unit} to {to}, but agrees with the model without this conversion: "
    'leave "[{unit}]" out of the header'
)
CONVERTED_UNIT = Template("E-LOG-063", _CONVERTED_UNIT)
PERHAPS_CONVERTED_UNIT = Template("W-LOG-068", _CONVERTED_UNIT)
_DELAY = "{direction} the model by {delay} ± {error}: {cause}, {doubt}"
DELAY = Template("W-LOG-066", _DELAY)
POSSIBLE_DELAY = Template("N-LOG-067", _DELAY)

# -- tables ---------------------------------------------------------------------------------------
