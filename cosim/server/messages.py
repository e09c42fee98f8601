"""Messages of the local server."""

from cosim.base.messages import Template

PORT_IN_USE = Template(
    "E-SRV-001", "port {port} is in use by another program; give another one, or 0 for any free port"
)
PORT_REFUSED = Template("E-SRV-002", "port {port} cannot be used: {reason}; give another one, or 0 for any free port")
PAGE_STAYS = Template("N-SRV-003", "the page stays until it is closed in the browser; Ctrl-C ends it")
