"""Messages of worker processes and limits."""

from cosim.base.messages import Template

NO_LIMIT = Template("E-ISO-007", "it is a number above 0 with its unit ({units}), {example} for one")
