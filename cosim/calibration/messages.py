"""Messages of fits."""

from cosim.base.messages import Template

# -- what is varied -------------------------------------------------------------------------------


# -- logs -----------------------------------------------------------------------------------------


# -- the estimate ---------------------------------------------------------------------------------


# -- reasons --------------------------------------------------------------------------------------


# -- studies --------------------------------------------------------------------------------------

OWN_STEP_ABOVE = Template(
    "E-CAL-037",
    "its co-simulation takes steps of its own of about {own:.3g} s, above the {step:.3g} s of the logs, so its results "
    "are wrong there; export it with a shorter step, or record rows every {own:.3g} s",
)
