"""Messages of worker processes and limits."""

from cosim.base.messages import Template

CRASH = Template("E-ISO-001", "{call} {end}")
CRASH_WITH_WORDS = Template("E-ISO-002", "{call} {end}; it said last: {words}")
NO_LIMIT = Template("E-ISO-007", "it is a number above 0 with its unit ({units}), {example} for one")
OUTPUT_LEFT_OUT = Template("N-ISO-009", "(the FMUs print more, which is left out)")
