"""Messages of scenarios, their start values and their controller designs."""

from cosim.base.messages import Template

# -- form -----------------------------------------------------------------------------------------
STEP_NOT_A_DIVISOR = Template(
    "E-SCN-004",
    "step is {step:g} s; use a whole divisor of duration {duration:g} s, {divisor:.6g} s for one",
)
NO_BAND = Template("E-SCN-005", "{kind} needs a band; add the allowed distance from its target")
NEEDLESS_BAND = Template("E-SCN-006", "{kind} takes no band; leave it out")

# -- overrides ------------------------------------------------------------------------------------
OVERRIDE_WITHOUT_VALUE = Template("E-SCN-009", "{override} is not path=value; for example --set noise=off")
OVERRIDE_OF_NO_COMPONENT = Template(
    "E-SCN-010",
    '{override} is for component "{name}", which is not in the scenario{hint} (its components: {components})',
)
OVERRIDE_OF_NOTHING = Template("E-SCN-011", "{override} leads nowhere: there is no {path} in the scenario")

# -- refined models -------------------------------------------------------------------------------

# -- controller design ----------------------------------------------------------------------------

# -- real time ------------------------------------------------------------------------------------
