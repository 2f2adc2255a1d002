"""The web server of the live page: page, socket, download of an episode."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import os
import secrets
import socket
import tempfile
from collections.abc import AsyncIterator, Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sidestep._bounds import SEED, bounded, check
from sidestep._packages import needed
from sidestep.loop import Trajectory, save_trajectory
from sidestep.loop.policies import as_policy
from sidestep.safety.shields.catalogue import SHIELDS
from sidestep.views.play.control import STRATEGIES
from sidestep.views.play.greeting import greeting
from sidestep.views.play.limits import Limits
from sidestep.views.play.origins import is_known_host, is_own_origin
from sidestep.views.play.programs import Programs
from sidestep.views.play.sliders import YOU
from sidestep.world import Scenario

if TYPE_CHECKING:
    from sidestep.views.play.session import Session

STATIC = Path(__file__).with_name("static")
_ENDLESS = 2**30
"""Time limit in control periods; the page's episodes end by capture or collision only."""
_FULL = 4013
"""Close code of a connection refused because of too many visitors."""
_HEADERS = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; connect-src 'self'; "
        "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-cache",
}

Saver = Callable[[Path, Trajectory, Scenario, Mapping[str, Any]], None]
"""Writes an episode to a file: path, trajectory, scenario, metadata."""


def _save_npz(path: Path, trajectory: Trajectory, scenario: Scenario, about: Mapping[str, Any]) -> None:
    save_trajectory(path, trajectory, scenario, about)


@dataclass(frozen=True)
class Hosting:
    """The settings of the page.

    `shield` and `pursuer` (a strategy, or `you`) initially; `allowed_hosts`, further host names besides
    addresses and `localhost` under which the page is served; `savers` of episodes by file suffix.
    """

    scenario: Scenario
    policy: Any = "goal-seeking"
    shield: str = "joint"
    pursuer: str = YOU
    seed: int = bounded(0, SEED)
    limits: Limits = field(default_factory=Limits)
    allowed_hosts: tuple[str, ...] = ()
    savers: Mapping[str, Saver] = field(default_factory=dict)


class PlayError(ValueError):
    """The page cannot be served; the message says what to install or change."""


def endless(scenario: Scenario) -> Scenario:
    """The scenario without a time limit."""
    return replace(scenario, episode_steps=_ENDLESS)


def make_app(hosting: Hosting) -> Any:
    """The page as an ASGI application. Its `state` has the `visitors` by token and the `programs`.

    **Raises** `PlayError` when the extra `[play]` is not installed, and `ValueError` for an unknown shield or
    pursuer.
    """
    for package in ("msgspec", "starlette"):
        needed(package, "play", "the live page needs", PlayError)
    from starlette.applications import Starlette
    from starlette.responses import FileResponse, JSONResponse, Response
    from starlette.routing import Mount, Route, WebSocketRoute
    from starlette.staticfiles import StaticFiles
    from starlette.websockets import WebSocketDisconnect

    from sidestep.views.play.session import Session
    from sidestep.views.play.visitor import Gone, Visitor

    check_hosting(hosting)
    limits = hosting.limits
    scenario = endless(hosting.scenario)
    programs = Programs(scenario, as_policy(hosting.policy, scenario))
    workers = ThreadPoolExecutor(max(os.cpu_count() or 1, 2), thread_name_prefix="sidestep-play")
    savers: dict[str, Saver] = {"npz": _save_npz, **hosting.savers}
    visitors: dict[str, Session | None] = {}
    seeds = itertools.count(hosting.seed)

    async def page(request: Any) -> Any:
        return FileResponse(STATIC / "index.html", headers=_HEADERS)

    async def health(request: Any) -> Any:
        return JSONResponse({"visitors": len(visitors), "room": limits.visitors}, headers=_HEADERS)

    async def episode(request: Any) -> Any:
        session, suffix = visitors.get(request.path_params["token"]), request.path_params["suffix"]
        if session is None or suffix not in savers:
            return Response("There is no such episode.", 404, headers=_HEADERS)
        loop = asyncio.get_running_loop()
        try:
            content = await loop.run_in_executor(workers, _written, session, savers[suffix], suffix)
        except ValueError as error:
            return Response(str(error), 409, headers=_HEADERS)
        name = f"sidestep-episode.{suffix}"
        headers = {**_HEADERS, "Content-Disposition": f'attachment; filename="{name}"'}
        return Response(content, media_type="application/octet-stream", headers=headers)

    async def live(websocket: Any) -> None:
        if not is_own_origin(websocket.headers):
            await websocket.close(1008)
            return
        if len(visitors) >= limits.visitors:
            # Accepted first, so that the page can distinguish this from a missing server.
            await websocket.accept()
            await websocket.close(_FULL, "no room for another visitor")
            return
        token = secrets.token_urlsafe(16)
        visitors[token] = None
        try:
            await websocket.accept()
            loop = asyncio.get_running_loop()
            session = await loop.run_in_executor(
                workers, Session, programs, hosting.shield, hosting.pursuer, limits, next(seeds)
            )
            visitors[token] = session

            async def receive() -> str | bytes | None:
                message = await websocket.receive()
                if message["type"] != "websocket.receive":
                    raise Gone("closed")
                return message.get("text")

            async def send(text: str) -> None:
                try:
                    await websocket.send_text(text)
                except (WebSocketDisconnect, RuntimeError, OSError) as error:
                    raise Gone("closed") from error

            visitor = Visitor(session, limits, workers, receive, send)
            await visitor.run(greeting(session.base, hosting.policy, token=token, formats=list(savers)))
        except (Gone, WebSocketDisconnect):
            pass
        finally:
            visitors.pop(token, None)
            with contextlib.suppress(RuntimeError, WebSocketDisconnect, OSError):
                await websocket.close(1001)

    @contextlib.asynccontextmanager
    async def lifespan(app: Any) -> AsyncIterator[None]:
        # The program without a shield compiles fast; the others take longer.
        programs.warm("none", hosting.shield)
        yield
        programs.close()
        workers.shutdown(wait=False, cancel_futures=True)

    class Static(StaticFiles):
        """Static files with the security headers."""

        async def get_response(self, path: str, scope: Any) -> Any:
            response = await super().get_response(path, scope)
            response.headers.update(_HEADERS)
            return response

    app = Starlette(
        routes=[
            Route("/", page),
            Route("/health", health),
            Route("/episode/{token}.{suffix}", episode),
            WebSocketRoute("/live", live),
            Mount("/static", Static(directory=STATIC)),
        ],
        lifespan=lifespan,
    )
    app.state.visitors, app.state.programs = visitors, programs
    return _KnownHosts(app, hosting.allowed_hosts)


class _KnownHosts:
    """Refuses requests addressed to an unknown host name."""

    def __init__(self, app: Any, allowed: tuple[str, ...]):
        self.app, self.state = app, app.state
        self._allowed = frozenset(name.lower() for name in allowed)

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        if scope["type"] in ("http", "websocket"):
            headers = {name.decode("latin-1"): value.decode("latin-1") for name, value in scope["headers"]}
            if not is_known_host(headers.get("host"), self._allowed):
                await _refuse(scope, receive, send)
                return
        await self.app(scope, receive, send)


async def _refuse(scope: Any, receive: Any, send: Any) -> None:
    if scope["type"] == "websocket":
        await receive()
        await send({"type": "websocket.close", "code": 1008})
        return
    text = b"This page answers to addresses and localhost; other names: sidestep play --allow-host NAME\n"
    headers = [(b"content-type", b"text/plain"), (b"content-length", str(len(text)).encode())]
    await send({"type": "http.response.start", "status": 421, "headers": headers})
    await send({"type": "http.response.body", "body": text})


def check_hosting(hosting: Hosting) -> None:
    """**Raises** `ValueError` for an unknown shield or pursuer, or a number out of its bounds."""
    if hosting.shield not in SHIELDS:
        raise ValueError(f"no shield {hosting.shield!r}; use one of {', '.join(map(repr, SHIELDS))}")
    if hosting.pursuer not in (YOU, *STRATEGIES):
        raise ValueError(f"no pursuer {hosting.pursuer!r}; use {YOU} or one of {', '.join(STRATEGIES)}")
    check(hosting)
    check(hosting.limits)


def _written(session: Session, saver: Saver, suffix: str) -> bytes:
    recording, arrays, scenario, about = session.record()
    trajectory = recording.trajectory(*arrays)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"episode.{suffix}"
        saver(path, trajectory, scenario, about)
        return path.read_bytes()


def listen(host: str, port: int) -> socket.socket:
    """A listening socket; port 0 selects a free one.

    **Raises** `PlayError` when the address or port is not available.
    """
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(
            host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )[0]
        listener = socket.socket(family, kind, protocol)
    except (OSError, OverflowError) as error:
        raise PlayError(f"no such address: {host}, port {port} ({error})") from None
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        # A small buffer, so that little data waits for a slow visitor; connections inherit it.
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 16384)
        listener.bind(address)
        listener.listen(64)
    except OSError as error:
        listener.close()
        raise PlayError(f"cannot listen on {host}, port {port} ({error}); choose another --port") from None
    return listener


def make_server(app: Any, limits: Limits) -> Any:
    """A uvicorn server for the application, with its limits; run it with `server.run(sockets=[...])`.

    **Raises** `PlayError` when the extra `[play]` is not installed.
    """
    uvicorn = needed("uvicorn", "play", "the live page needs", PlayError)
    needed("websockets", "play", "the live page needs", PlayError)
    from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

    class Protocol(WebSocketsSansIOProtocol):
        """Pauses sending when a few frames wait in the buffer."""

        def connection_made(self, transport: Any) -> None:
            transport.set_write_buffer_limits(high=8192)
            super().connection_made(transport)

    config = uvicorn.Config(
        app,
        log_level="warning",
        access_log=False,
        server_header=False,
        ws=Protocol,
        ws_max_size=limits.message_bytes,
        ws_ping_interval=10.0,
        ws_ping_timeout=15.0,
        ws_per_message_deflate=False,
        # Page, files and socket of every visitor at once, and as many again that are refused.
        limit_concurrency=32 * (limits.visitors + 1),
        h11_max_incomplete_event_size=16384,
        timeout_graceful_shutdown=2,
    )
    return uvicorn.Server(config)


def serve(
    hosting: Hosting,
    host: str = "127.0.0.1",
    port: int = 8765,
    *,
    announce: Callable[[str], None] | None = None,
) -> None:
    """Serve the page until interrupted; `announce(address)` is called once it is available.

    **Raises** as `make_app` and `listen`.
    """
    app = make_app(hosting)
    server = make_server(app, hosting.limits)
    with listen(host, port) as listener:
        name, port = listener.getsockname()[:2]
        if ":" in name:
            name = f"[{name}]"
        if announce is not None:
            announce(f"http://{name}:{port}/")
        server.run(sockets=[listener])
