"""Messages of fits."""

from cosim.base.messages import Template

DIFFERENT_NOISE = Template(
    "W-FIT-001",
    "the noise in the logs differs from the stated noise ({levels}); the noise of the logs is used. "
    "Write {line} into the study to state it",
)
UNSTATED_NOISE = Template(
    "W-FIT-002",
    "the model does not state the noise of {outputs} (sensor_variance); the logs show {line}, which is used. "
    "Write it into the study to state another",
)
CELLS = Template(
    "W-FIT-003",
    "the readings repeat a few values: {cells}. The noise of such a sensor is at least its cell over √12; "
    "this is read off the logs, and no candidate",
)
