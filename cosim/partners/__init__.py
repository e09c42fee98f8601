"""Messages between a run and its partners, over UDP and MQTT."""
