"""Messages of logs."""

from cosim.base.messages import Template

# -- columns --------------------------------------------------------------------------------------


# -- clock ----------------------------------------------------------------------------------------

_JITTER = (
    "rows are {step} apart, give or take {spread} (at most {worst}); "
    "replays step at their times, the filter of `cosim refine` at equal ones"
)

# -- inputs and outputs ---------------------------------------------------------------------------


# -- units and signs ------------------------------------------------------------------------------

_OPPOSITE_RATE = (
    "has the opposite sign of d {name}/dt (slope {slope}); "
    "turn one of them round: the rate is positive where the signal grows"
)
_DEGREES = "is {factor} times what {other} says: one is in degrees, the other in radians. {cure}"

_OTHER_SIZE = 'is its unit {unit}? Then call the column "{name} [{unit}]"'
_OTHER_SLOPE = "moves with the model, but {slope} ± {error} times as far; " + _OTHER_SIZE
OTHER_SLOPE = Template("E-LOG-062", _OTHER_SLOPE)
PERHAPS_OTHER_SLOPE = Template("W-LOG-060", _OTHER_SLOPE)
_CONVERTED_UNIT = (
    "was converted from {unit} to {to}, but agrees with the model without this conversion: "
    'leave "[{unit}]" out of the header'
)
_DELAY = "{direction} the model by {delay} ± {error}: {cause}, {doubt}"

# -- tables ---------------------------------------------------------------------------------------
