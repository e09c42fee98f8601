"""Messages of controller design."""

from cosim.base.messages import Template

# Modules that go into an FMU do not import this one: they raise a plain ValueError, whose text is a `reason` here.

ONE_SIDED_RANGE = Template(
    "E-CTL-001", "{name}={low:g}..{high:g}: the controller tilts both ways; give a range about 0"
)
OTHER_MODEL = Template("E-CTL-002", "is a {model}; this controller flies the {craft} and nothing else")
OPTION_OUT_OF_BOUNDS = Template("E-CTL-003", "{value:g} lies outside [{low:g}, {high:g}]{unit}; take a value inside")
UNEQUAL_TILT_WEIGHTS = Template(
    "E-CTL-004",
    "{weights} weighs one tilt more; the predictive law takes one weight for both: write the same number twice",
)
INVALID_PARAMETERS = Template("E-CTL-005", "the settings are not possible together: {error}")
INVALID_POLES = Template("E-CTL-006", "the poles cannot be placed: {error}")
REPEATED_POLE = Template("E-CTL-007", "{pole} stands twice in the {axis} axis; one input places a pole once")
POLE_WITHOUT_CONJUGATE = Template("E-CTL-008", "{pole} needs {conjugate} in the same axis")
UNSTABLE_POLE = Template("E-CTL-009", "{pole} rad/s is not stable; the real part of a pole is below 0")
SLOW_POLE = Template(
    "E-CTL-010",
    "{pole} rad/s is too slow: what it moves takes {time:.0f} s to fall to 37 %, and nearer to 0 than {least:g} rad/s "
    "it cannot be distinguished from one that grows; take -{least:g} rad/s or further left",
)
UNCONTROLLABLE_POLE = Template(
    "E-CTL-011", "no input moves the pole {pole} rad/s, of {states}; correct the craft's parameters"
)
INVALID_WEIGHTS = Template("E-CTL-012", "Q has five diagonal entries ≥ 0 and R two > 0; correct them")
INVALID_INTEGRAL_WEIGHTS = Template(
    "E-CTL-013", "Q has five diagonal entries ≥ 0, R two > 0 and Q_integral two > 0; correct them"
)
NO_STABILISING_GAIN = Template(
    "E-CTL-014", "no stabilising gain for these weights: {reason}; weigh every position above 0"
)
LARGE_GAIN = Template(
    "E-CTL-015", "asks for a gain of {size:.3g}, and the controller takes {limit:g} at most; ask for a slower loop"
)
UNSTABLE_LOOP = Template(
    "E-CTL-016",
    "is not stable as it flies, with the lag of {lag:g} s, a sample of {sample:g} s and the estimator {estimator} the "
    "{axis} axis has a pole at {pole} rad/s{cure}",
)
WEAK_DAMPING = Template(
    "W-CTL-017",
    "design.{option}: with the lag of {lag:g} s, a sample of {sample:g} s and the estimator {estimator} the {axis} "
    "axis has a pole at {pole} rad/s, hardly damped by {damping:.2g}: a swing keeps {ratio:.0f} % of its size{cure}",
)
OTHER_STEP = Template("E-CTL-018", "step of {step} s; the controller is sampled at {sample} s (parameter sample_time)")
