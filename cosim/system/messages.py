"""Messages of a scenario's components, connections, schedule and events."""

from cosim.base.messages import Template

# Components
COUNT_NAME_TAKEN = Template(
    "E-SYS-006", '"{name}" is already the name of the output that counts the fixes; give the signal another name'
)
FIX_NAME_TAKEN = Template(
    "E-SYS-007",
    '"{name}" is already the name of an output with the fixes of another signal; give the signal another name',
)

# Keys of the scenario

# Step control

# Events

# Schedule
LEFT_OPEN = Template(
    "W-SYS-100",
    "{loop} may be an algebraic loop, which {by} leaves open, so that some inputs have the values of the step before; "
    "{cure}",
)
NO_LOOP_AT_START = Template(
    "N-SYS-103",
    "{loop} is no algebraic loop at the start, as measured or stated by feedthrough: [...]; if outputs follow inputs "
    "at once later, {cure}",
)
LOOP_BY_FEEDTHROUGH = Template(
    "N-SYS-102",
    "{loop} is an algebraic loop that no FMU declares: outputs follow {inputs} at once, as measured before the run or "
    "stated by feedthrough: [...]. It is solved at each communication point; order: [...] leaves it open",
)

# Connections
INPUTS_NOT_CONNECTED = Template("W-SYS-039", "not connected, at the start value of the FMU: {names}")
FIXES_NOT_CONNECTED = Template("W-SYS-040", "inputs not connected, so their fixes are 0: {names}")

# Injected faults

# Event mode and clocks

# Partners
