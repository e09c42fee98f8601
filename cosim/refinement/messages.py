"""Messages of refinement studies."""

from cosim.base.messages import Template

# Logs of a study

# Keys of a study

# Parameters per log and groups

# Results in Python

# Warnings

# Studies of FMUs

# Outlook of `cosim check` on a study of an FMU
OWN_STEP_ABOVE = Template(
    "E-REF-062",
    "{name} has no usable model exchange ({reason}), and its co-simulation takes steps of its own of about {own:.3g} s,"
    " above the {step:.3g} s of the logs, so its results are wrong there; export it for model exchange or with a "
    "shorter step, or record rows every {own:.3g} s",
)
