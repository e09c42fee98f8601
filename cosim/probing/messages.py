"""Messages of probing."""

from cosim.base.messages import Template

DERIVATIVES_WITHOUT_STATES = Template(
    "E-PRB-001", "does not declare the state of every derivative; probe its co-simulation, or export it again"
)
NO_MODEL_EXCHANGE = Template("E-PRB-002", "has no usable interface for {way}; it offers {ways}")
