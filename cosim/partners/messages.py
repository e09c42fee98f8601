"""Messages on partners of a run."""

from cosim.base.messages import Template

NO_PORT = Template("E-PRT-001", "cannot receive at {address}: {reason}; choose another port, or end what uses it")
NO_HOST = Template("E-PRT-004", "cannot send to {address}: {reason}; correct the host, or give its IP address")
NO_BROKER = Template("E-PRT-002", "no MQTT broker at {address}: {reason}; start one, or name another as broker")
NO_MQTT = Template("E-PRT-003", "mqtt needs paho-mqtt: pip install 'fmu-cosim[mqtt]'")
