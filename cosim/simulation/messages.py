"""Messages of runs."""

from cosim.base.messages import Template

ROWS_NOT_COMPLETE = Template("E-SIM-095", "its rows are not all written: it was killed meanwhile, or still writes them")
LOOP_LEFT_OPEN = Template(
    "W-SIM-080",
    "{loop} is an algebraic loop that no FMU declares: measured before the run, {facts}. It is left open, so that some "
    "inputs have the values of the step before, because solving it fails: {reason}",
)
FOLLOWS_AT_START = Template(
    "W-SIM-081",
    "{loop} may be an algebraic loop that no FMU declares: in initialization {facts}, later only with a step. "
    "It is left open, so that some inputs may have the values of the step before; {cure}",
)
NOT_MEASURED = Template(
    "W-SIM-083",
    "{loop} may be an algebraic loop: whether outputs follow {inputs} at once is not declared, nor measured{reason}; "
    "cosim assumes that none does; feedthrough: [...] of the component names the inputs that an output follows, [] for "
    "none; loops: {{}} solves it; order: [...] states the order instead",
)
