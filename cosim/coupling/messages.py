"""Messages of coupling algorithms."""

from cosim.base.messages import Template

ASSUMED_WITHOUT_FEEDTHROUGH = Template(
    "W-CPL-001",
    "{component} does not declare which outputs depend directly on its inputs; taken as none, so that it steps first. "
    "State order: if that is wrong",
)
