"""Messages of the server of FMUs."""

from cosim.base.messages import Template

NO_FOLDER = Template("E-SVG-001", "is no folder; name folders with FMUs")
NO_KEYS = Template(
    "E-SVG-002",
    "{host} can be reached from other machines, so a key is needed: --key FILE of the server's secret key and "
    "--clients FOLDER of public keys of clients (--new-key NAME makes both files of a key)",
)
NO_CLIENTS = Template("E-SVG-003", "holds no public key of a client (NAME.key), so nobody could connect")
KEY_EXISTS = Template("E-SVG-004", "is there already; a new key would lock out those who know the old one")
PORT_IN_USE = Template("E-SVG-005", "port {port} is in use by another program; give another one")
PORT_REFUSED = Template("E-SVG-006", "{host}:{port} cannot be used: {reason}")
OTHER_VERSION = Template(
    "E-SVG-007", "the server has version {here} of the protocol, the client version {there}; install the same cosim"
)
BAD_REQUEST = Template("E-SVG-008", "the server does not understand the request: {reason}")
NOT_OFFERED = Template(
    "E-SVG-009", "the server offers no {fmu}; a name is that of a file within its folders, which hold {names}"
)
OTHER_CONTENT = Template("E-SVG-010", "the server's {fmu} is not the FMU of sha256, but another one")
AMBIGUOUS = Template("E-SVG-011", "several folders of the server hold different FMUs named {fmu}; give sha256 too")
INVALID = Template("E-SVG-012", "the server's {fmu} cannot be used: {error}")
BUSY = Template("E-SVG-013", "the server has {count} sessions, which is its limit; try again later")
NO_PORT = Template("E-SVG-014", "the server finds no free port among {first} … {last} for the session")
CLIENT_GONE = Template("E-SVG-016", "its client is gone")
UNEXPECTED = Template("E-SVG-015", "{error}: {reason}")
