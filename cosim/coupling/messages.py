"""Messages of coupling algorithms."""

from cosim.base.messages import Template

ASSUMED_WITHOUT_FEEDTHROUGH = Template(
    "W-CPL-001",
    "{component} does not declare which outputs depend directly on its inputs; cosim assumes that none does, so "
    "{component} steps first. feedthrough: [...] of {component} names the inputs that an output follows at once, [] "
    "for none; order: [...] states the order instead",
)
