"""The server of the page: on this machine alone, for who knows its address.

Starlette and uvicorn: the page is a canvas that a person draws on, with few controls beside it; a toolkit of widgets
would stand in its way, and what is left to a server is files, JSON and one stream of events.
"""

from __future__ import annotations

import asyncio
import json
import secrets
import shutil
import webbrowser
from collections.abc import AsyncIterator, Callable
from dataclasses import dataclass
from importlib import resources
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from fluidlift.config import JobConfig
from fluidlift.errors import FluidliftError, InputRejected, MissingPackage
from fluidlift.io.atomic import new_temporary
from fluidlift.io.limits import parse_json
from fluidlift.pipeline import Inputs
from fluidlift.pipeline.models import NO_MODELS, ModelWish
from fluidlift.served import PAGE_HEADERS, free_port, knows, same_origin
from fluidlift.studio.clips import LARGEST, clips_in, name_for
from fluidlift.studio.desk import Desk

HOST, FIRST_PORT = "127.0.0.1", 8180
LARGEST_JSON = 2**21
"""bytes of what the page sends"""
LOOKED_AT = 0.05
"""s between two looks at whether there is something new"""
STILL_THERE = 15.0
"""s after which a stream without news says that it is alive"""
POLICY = (
    "default-src 'self'; img-src 'self' blob: data:; object-src 'none'; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'"
)
TYPES = {
    ".html": "text/html; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".css": "text/css; charset=utf-8",
}


@dataclass(frozen=True)
class StudioRequest:
    """Where the page is served."""

    port: int = FIRST_PORT
    """the next free one is taken where it is not"""
    browser: bool = True
    """open the page in the default browser"""
    learned: ModelWish = NO_MODELS
    """models that looks and makes take"""


def open_desk(place: Path, learned: ModelWish = NO_MODELS) -> tuple[Desk, str | None]:
    """The desk of a folder, or of the folder of a clip, and the name of that clip.

    Args:
        place: the folder, or the clip.
        learned: models that its looks and makes take.

    Raises:
        InputRejected: no such folder or clip.
    """
    if place.is_dir():
        return Desk(place.absolute(), learned), None
    if not place.is_file():
        raise InputRejected(
            f"no such clip or folder: '{place}'", "a video, or a folder of videos and assets", "check the name"
        )
    folder = place.absolute().parent
    if place.name not in clips_in(folder):
        raise InputRejected(
            f"'{place.name}' is no video by its name", "a video file", "for picture sequences: fluidlift hints"
        )
    return Desk(folder, learned), place.name


def studio(place: Path, request: StudioRequest | None = None, *, told: Callable[[str], None] = print) -> None:
    """Serve the page until the process is interrupted.

    Args:
        place: a clip, or a folder of clips and assets.
        request: where.
        told: takes lines for a person.

    Raises:
        MissingPackage: starlette or uvicorn is not installed, or what a model needs.
        InputRejected: no such place, no port is free, or models that cannot be taken.
    """
    _require_packages()
    import uvicorn

    request = request or StudioRequest()
    for line in request.learned.on(JobConfig(), Inputs(place)).told:
        told(f"models: {line}")
    desk, name = open_desk(place, request.learned)
    try:
        port, secret = free_port(HOST, request.port), secrets.token_urlsafe(16)
        address = f"http://{HOST}:{port}/{secret}/"
        if name is not None:
            desk.open(name)
        told(f"studio of {desk.folder}: {address}   (Ctrl-C closes it; nothing is lost)")
        if request.browser:
            webbrowser.open(address)
        # a stream of events never ends by itself
        config = uvicorn.Config(
            app_of(desk, secret), host=HOST, port=port, log_level="error", access_log=False, timeout_graceful_shutdown=1
        )
        uvicorn.Server(config).run()
    except KeyboardInterrupt:
        told("closed")
    finally:
        desk.close()


def _require_packages() -> None:
    if find_spec("starlette") is None or find_spec("uvicorn") is None:
        raise MissingPackage("The studio needs starlette and uvicorn: pip install 'fluidlift[studio]'")


def app_of(desk: Desk, secret: str) -> Any:
    """The ASGI application, behind its secret."""
    from starlette.applications import Starlette
    from starlette.routing import Route

    routes = [Route("/", _page), Route("/page/{name}", _page), Route("/events", _events), Route("/state", _state)]
    routes += [Route("/first.jpg", _first), Route("/strip/{number:int}.jpg", _strip)]
    routes += [Route("/frames/{key:int}/{number:int}.jpg", _frame), Route("/masks/{key:int}/{number:int}.png", _mask)]
    routes += [Route("/stages/{name}.jpg", _stage_picture)]
    routes += [Route("/shelf/{name}/picture.jpg", _shelf_picture)]
    routes += [Route("/clips", _upload, methods=["POST"]), Route("/do/{what}", _do, methods=["POST"])]
    app = Starlette(routes=routes)
    app.state.desk = desk
    return Guard(app, secret)


class Guard:
    """Lets only those in who know the secret, and no page of another origin.

    Args:
        app: what is served.
        secret: the first part of each path.
    """

    def __init__(self, app: Any, secret: str) -> None:
        self._app, self._secret = app, secret

    async def __call__(self, scope: dict[str, Any], receive: Any, send: Any) -> None:
        """As ASGI calls it."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        from starlette.responses import PlainTextResponse

        headers = {k.decode("latin-1").lower(): v.decode("latin-1") for k, v in scope["headers"]}
        known, path = knows(scope["path"], self._secret)
        if not known:
            await PlainTextResponse("Open the whole address that fluidlift studio printed.\n", 403)(
                scope, receive, send
            )
            return
        host = headers.get("host", "")
        # what changes something must come from the page itself: a browser names its origin there
        changes = scope["method"] not in ("GET", "HEAD")
        if not same_origin(headers.get("origin"), host) or (changes and "origin" not in headers):
            await PlainTextResponse("A page of another origin is not let in.\n", 403)(scope, receive, send)
            return
        if host.rpartition(":")[0] not in (HOST, "localhost"):
            await PlainTextResponse("This host is not served.\n", 403)(scope, receive, send)
            return

        async def guarded(message: dict[str, Any]) -> None:
            if message["type"] == "http.response.start":
                more = PAGE_HEADERS | {"Content-Security-Policy": POLICY}
                added = [(k.lower().encode(), v.encode()) for k, v in more.items()]
                message = message | {"headers": [*message.get("headers", []), *added]}
            await send(message)

        await self._app(scope | {"path": path, "raw_path": path.encode()}, receive, guarded)


def _plain(data: Any, status: int = 200) -> Any:
    from starlette.responses import Response

    return Response(json.dumps(data), status, media_type="application/json", headers={"Cache-Control": "no-store"})


def _bytes(data: bytes, kind: str, *, lasting: bool = False) -> Any:
    from starlette.responses import Response

    cache = "private, max-age=86400, immutable" if lasting else "no-store"
    return Response(data, media_type=kind, headers={"Cache-Control": cache})


def _nothing() -> Any:
    """A picture that is not there yet, or no longer: newer ones are told of by the state."""
    from starlette.responses import Response

    return Response(status_code=204, headers={"Cache-Control": "no-store"})


async def _answered(work: Callable[[], Any]) -> Any:
    """What work returns, as JSON; what is refused, with its reason. That is an answer as well, and no fault."""
    try:
        return _plain({"done": await asyncio.to_thread(work)})
    except FluidliftError as error:
        return _plain({"error": str(error)})
    except OSError as error:
        return _plain({"error": f"{error.strerror or error}: {error.filename or ''}"})


async def _pictured(work: Callable[[], bytes], kind: str, *, lasting: bool = True) -> Any:
    try:
        return _bytes(await asyncio.to_thread(work), kind, lasting=lasting)
    except FluidliftError:
        return _nothing()


async def _page(request: Any) -> Any:
    name = request.path_params.get("name", "index.html")
    files = {f.name: f for f in resources.files("fluidlift.studio").joinpath("page").iterdir()}
    if name not in files:
        return _plain({"error": f"no file '{name[:40]}'"}, 404)
    return _bytes(files[name].read_bytes(), TYPES.get(Path(name).suffix, "application/octet-stream"))


async def _state(request: Any) -> Any:
    return _plain(await asyncio.to_thread(request.app.state.desk.state))


async def _events(request: Any) -> Any:
    from starlette.responses import StreamingResponse

    desk: Desk = request.app.state.desk

    async def told() -> AsyncIterator[str]:
        last, quiet = -1, 0.0
        while True:
            if desk.version != last:
                state = await asyncio.to_thread(desk.state)
                last, quiet = state["version"], 0.0
                yield f"data: {json.dumps(state)}\n\n"
            elif quiet > STILL_THERE:
                quiet = 0.0
                yield ": still there\n\n"
            await asyncio.sleep(LOOKED_AT)
            quiet += LOOKED_AT

    return StreamingResponse(told(), media_type="text/event-stream", headers={"Cache-Control": "no-store"})


async def _first(request: Any) -> Any:
    strip = request.app.state.desk.strip
    return _nothing() if strip is None or not strip.first else _bytes(strip.first, "image/jpeg")


async def _strip(request: Any) -> Any:
    strip, number = request.app.state.desk.strip, request.path_params["number"]
    if strip is None or number >= len(strip.pictures):
        return _nothing()
    return _bytes(strip.pictures[number], "image/jpeg")


async def _frame(request: Any) -> Any:
    desk, number = request.app.state.desk, request.path_params["number"]
    if request.path_params["key"] != desk.looking.look.pictures:
        return _nothing()
    return await _pictured(lambda: desk.frame(number), "image/jpeg")


async def _mask(request: Any) -> Any:
    desk, number = request.app.state.desk, request.path_params["number"]
    if request.path_params["key"] != desk.looking.look.masks:
        return _nothing()
    return await _pictured(lambda: desk.mask(number), "image/png")


async def _stage_picture(request: Any) -> Any:
    desk, name = request.app.state.desk, request.path_params["name"]
    return await _pictured(lambda: desk.stage_picture(name), "image/jpeg", lasting=False)


async def _shelf_picture(request: Any) -> Any:
    desk, name = request.app.state.desk, request.path_params["name"]
    return await _pictured(lambda: desk.shelf.picture(name), "image/jpeg", lasting=False)


async def _upload(request: Any) -> Any:
    """A clip that was dropped, block by block, under its name once all of it is there."""
    desk: Desk = request.app.state.desk
    try:
        target = name_for(desk.folder, request.query_params.get("name", ""))
        told = int(request.headers.get("content-length", "0") or 0)
        room = shutil.disk_usage(desk.folder).free
        if not 0 < told <= min(LARGEST, room):
            raise InputRejected(f"a clip of {told} bytes", f"1 to {min(LARGEST, room)} bytes", "cut it, or make room")
        temporary = new_temporary(desk.folder, target.stem, target.suffix)
        try:
            got = 0
            with temporary.open("wb") as file:
                async for block in request.stream():
                    got += len(block)
                    if got > told:
                        raise InputRejected("more bytes than were told", "the file itself")
                    await asyncio.to_thread(file.write, block)
            if got != told:
                raise InputRejected(f"{got} of {told} bytes came", "all of the file", "drop it again")
            temporary.rename(target)
        finally:
            temporary.unlink(missing_ok=True)
    except (FluidliftError, ValueError) as error:
        return _plain({"error": str(error)})
    except OSError as error:
        return _plain({"error": f"the clip cannot be written: {error.strerror or error}"})
    return await _answered(lambda: desk.open(target.name))


async def _do(request: Any) -> Any:
    """What a person does: a JSON object each."""
    body = b""
    async for block in request.stream():
        body += block
        if len(body) > LARGEST_JSON:
            return _plain({"error": "too much at once"}, 413)
    try:
        data = parse_json(body or b"{}")
    except ValueError:
        data = None
    act = _ACTS.get(request.path_params["what"])
    if act is None or not isinstance(data, dict):
        return _plain({"error": "unknown"}, 404)
    desk = request.app.state.desk
    return await _answered(lambda: act(desk, data))


def _name(data: dict[str, Any]) -> str:
    return str(data.get("name", ""))


_ACTS: dict[str, Callable[[Desk, dict[str, Any]], Any]] = {
    "open": lambda desk, data: desk.open(_name(data)),
    "change": lambda desk, data: desk.change(lambda history: history.change(data)),
    "undo": lambda desk, data: desk.change(lambda history: history.undo()),
    "redo": lambda desk, data: desk.change(lambda history: history.redo()),
    "fresh": lambda desk, data: desk.fresh_hints(),
    "make": lambda desk, data: desk.make(str(data.get("preset", "draft"))),
    "stop": lambda desk, data: desk.making.stop(),
    "view": lambda desk, data: desk.view(_name(data)),
    "export": lambda desk, data: desk.export(_name(data)),
    "duplicate": lambda desk, data: desk.on_shelf(lambda shelf: shelf.duplicate(_name(data))),
    "discard": lambda desk, data: desk.on_shelf(lambda shelf: shelf.discard(_name(data))),
    "restore": lambda desk, data: desk.on_shelf(lambda shelf: shelf.restore(_name(data))),
}
