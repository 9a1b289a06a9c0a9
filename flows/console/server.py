"""The console's web server, on this computer alone."""

import asyncio
import socket
import warnings
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any, Final
from urllib.parse import urlsplit

import uvicorn
from fastapi import FastAPI
from fastapi.responses import FileResponse, Response
from nicegui import ui

from components.evaluation.guarantee import USUAL, Guarantee
from flows.configuration.checking import SettingsError
from flows.console.catalogue import Catalogue
from flows.console.operate import Operate
from flows.console.windows import Windows

__all__ = ["HOST", "bound", "serve"]

HOST: Final = "127.0.0.1"
_PREFERRED: Final = 8085
_NAMES: Final = (HOST, "localhost")
_RECONNECT: Final = 20.0  # seconds that a session waits for a browser whose connection is lost
_SANDBOX: Final = ("Content-Security-Policy", "sandbox allow-scripts allow-popups")

Scope = dict[str, Any]
App = Callable[[Scope, Any, Any], Awaitable[None]]


class OnlyFromHere:
    """Refuses what pages of other sites ask for: they may reach this computer's own address.

    Args:
        app: What is protected.
    """

    def __init__(self, app: App) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Any, send: Any) -> None:
        """Pass a request on if its host, and its origin where there is one, is this computer."""
        if scope["type"] == "lifespan" or _own(dict(scope["headers"])):
            await self._app(scope, receive, send)
        elif scope["type"] == "websocket":
            await send({"type": "websocket.close", "code": 1008})
        else:
            await send({"type": "http.response.start", "status": 403, "headers": []})
            await send({"type": "http.response.body", "body": b"Not from here."})


def _own(headers: dict[bytes, bytes]) -> bool:
    host = urlsplit("//" + headers.get(b"host", b"").decode("latin-1"))
    origin = headers.get(b"origin")
    if host.hostname not in _NAMES:
        return False
    return origin is None or urlsplit(origin.decode("latin-1")).netloc == host.netloc


def bound(port: int | None) -> socket.socket:
    """A socket on this computer alone.

    Args:
        port: That is wanted; None: the usual one, or any that is free.

    Raises:
        SettingsError: The port is taken, or may not be used.
    """
    for wanted in (port,) if port is not None else (_PREFERRED, 0):
        own = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        own.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            own.bind((HOST, wanted))
            own.listen()
            return own
        except OSError as error:
            own.close()
            if port is not None:
                raise SettingsError(
                    f"port={port} cannot be used ({error.strerror}); leave it out to take a free "
                    "one."
                ) from error
    raise AssertionError("port 0 is always free")


def serve(
    own: socket.socket,
    store: Path,
    ready: Callable[[str], object],
    packed: Path | None = None,
    guarantee: Guarantee = USUAL,
) -> None:
    """Serve until Ctrl-C.

    Args:
        own: Where to listen.
        store: Folder of the runs.
        ready: Called with the address when it answers.
        packed: Folder of packed policies.
        guarantee: Of the autopilot.
    """
    catalogue, windows = Catalogue(store, packed), Windows()
    app = FastAPI(openapi_url=None)

    @ui.page("/", title="Operator's console")
    async def operate(policy: str = "") -> None:
        await Operate(catalogue, windows, store / "sessions", guarantee).show(policy)

    @ui.page("/sweep", title="Sweeps")
    async def sweep(name: str = "") -> None:
        from flows.console.sweep import Sweep  # whoever operates needs none of it
        from flows.console.sweeps import Sweeps

        await Sweep(Sweeps(store)).show(name)

    @app.get("/document")
    def document(name: str = "") -> Response:
        from flows.console.sweeps import Sweeps

        found = Sweeps(store).document(name)
        if found is None:
            return Response("There is no such document.", 404)
        kind = "text/html" if found.suffix == ".html" else "text/plain"
        # A page of its own: its scripts work, but cannot act on the console.
        return FileResponse(found, media_type=kind, headers={_SANDBOX[0]: _SANDBOX[1]})

    @app.get("/windows")
    def count() -> dict[str, int]:
        return {"windows": len(windows)}

    # NiceGUI looks at every object of the process, and Torch warns of some of its own.
    warnings.filterwarnings("ignore", category=FutureWarning, module="nicegui")
    ui.run_with(app, title="Operator's console", reconnect_timeout=_RECONNECT, tailwind=False)
    guarded = OnlyFromHere(app)
    config = uvicorn.Config(guarded, log_level="warning", ws_max_size=1_000_000)
    server = uvicorn.Server(config)

    async def main() -> None:
        serving = asyncio.create_task(server.serve(sockets=[own]))
        while not server.started and not serving.done():
            await asyncio.sleep(0.02)
        if server.started:
            ready(f"http://{HOST}:{own.getsockname()[1]}/")
        await serving

    asyncio.run(main())
