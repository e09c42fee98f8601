"""`cosim serve`: offer the FMUs of folders to other machines."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from cosim.verbs.terminal import say, some

MAX_NAMES = 10


def command(
    folders: Annotated[
        list[Path] | None, typer.Argument(metavar="FOLDER", help="Folder with FMUs; no other file is loaded.")
    ] = None,
    *,
    port: Annotated[int, typer.Option(min=0, max=65519, help="Port; sessions use the 16 behind it (0: any).")] = 0,
    host: Annotated[str, typer.Option(help="Address to listen at; any but 127.0.0.1 needs keys.")] = "127.0.0.1",
    key: Annotated[Path | None, typer.Option(help="File of this server's secret key.")] = None,
    clients: Annotated[Path | None, typer.Option(help="Folder with the public keys of all clients (*.key).")] = None,
    new_key: Annotated[
        Path | None, typer.Option("--new-key", metavar="NAME", help="Make NAME.key and NAME.key_secret, and end.")
    ] = None,
    check: Annotated[bool, typer.Option("--check", help="Say what would be offered, and end.")] = False,
    once: Annotated[bool, typer.Option("--once", help="End after the first session.")] = False,
) -> None:
    """Offer the FMUs of folders to other machines.

    Example: cosim serve fmus --port 5600
    """
    from cosim.serving.fmu_server import FmuServer, make_key

    def tell(text: str) -> None:
        say(text)
        sys.stdout.flush()  # A file or pipe gets each line at once, too.

    if new_key is not None:
        public, secret = make_key(new_key)
        say(f"{public} (public, give it to the other side)", f"{secret} (secret, keep it here)")
        return
    if not folders:
        raise typer.BadParameter("name at least one folder with FMUs")
    with FmuServer(folders, host=host, port=port, key=key, clients=clients, say=tell) as server:
        names = server.offer.names()
        by = "clients with a known key" if server.keys is not None else "programs of this machine, without keys"
        tell(f"{len(names)} FMUs at {host}:{server.port} for {by}: {some(names, MAX_NAMES) or 'none'}")
        if not check:
            server.run(once=once)
