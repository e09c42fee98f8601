"""Messages of experiments."""

from cosim.base.messages import Template

USUAL_INPUT_IS_BETTER = Template(
    "W-EXP-017",
    "{usual} separates better ({count} of {pairs}, the nearest {distance:.1f} standard deviations apart) "
    "but goes {excess:.1f} times as far as --limit allows",
)
