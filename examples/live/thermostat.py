"""A thermostat for oven_udp.yaml: receives temperatures by UDP and sends the power of the heater."""

import json
import socket
import sys

GOAL, BAND, POWER = 340.0, 2.0, 1500.0  # [K], [K], [W]


def main(receive: int = 5006, send: int = 5005) -> None:
    """Answer each message until none comes for 30 s."""
    power = POWER
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as link:
        link.bind(("127.0.0.1", receive))
        link.settimeout(30.0)
        print("ready", flush=True)
        while True:
            try:
                board = json.loads(link.recv(4096))["board"]
            except TimeoutError:
                return
            power = 0.0 if board > GOAL + BAND else POWER if board < GOAL - BAND else power
            link.sendto(json.dumps({"power": power}).encode(), ("127.0.0.1", send))


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
