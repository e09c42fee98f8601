"""Messages of comparisons."""

from cosim.base.messages import Template

# Reasons why run b does not match run a
SIGNALS_BEYOND = Template("E-CMP-009", "{count} beyond the tolerance")
SIGNALS_DIFFER = Template("E-CMP-010", "{count} {verb}")
