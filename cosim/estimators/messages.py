"""Messages of estimator tests."""

from cosim.base.messages import Template

BELOW_MINIMUM = Template("E-EST-001", "is {value}; give {least} or more")
NOT_ENOUGH_MEMORY = Template("E-EST-002", "there is not enough memory for {runs:,} runs of {steps:,} steps; give fewer")
TOO_MANY_RUNS = Template(
    "E-EST-003",
    "{runs:,} runs of {steps:,} steps are more than the {limit:,} samples that fit into memory; give {most:,} at most"
    " with {steps:,} steps",
)
TOO_MANY_STEPS = Template(
    "E-EST-004",
    "{runs:,} runs of {steps:,} steps are more than the {limit:,} samples that fit into memory; give {most:,} at most",
)
