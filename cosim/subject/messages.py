"""Messages of refined FMUs as SSPs."""

from cosim.base.messages import Template

NO_CO_SIMULATION = Template("E-SUB-001", "{file} offers no co-simulation, which importers of SSPs run")
INSIDE = Template("E-SUB-002", "{names} act inside the original, where an FMU beside it has no input")
HIDDEN_STATES = Template("E-SUB-003", "{names} need the states {states}, which no output of the original shows")
SSP_WANTED = Template("W-SUB-006", "The study wants an SSP")
NOTHING_DELIVERED = Template("W-SUB-004", "{reason}. An SSP cannot stand for it: {cure}")
SSP_INSTEAD = Template(
    "W-SUB-005", "{reason}. plant.ssp is delivered in place of plant.fmu: the original FMU and the terms beside it"
)
