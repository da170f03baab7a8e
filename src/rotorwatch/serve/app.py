"""The routes: the page and its files, the stream of live vehicles, the list of flights, their reports, and uploads."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from contextlib import asynccontextmanager
from dataclasses import fields
from typing import Any

from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect, Request
from starlette.responses import HTMLResponse, JSONResponse, Response, StreamingResponse
from starlette.routing import Route

from rotorwatch import __version__
from rotorwatch.base.choices import meant
from rotorwatch.base.files import one_line
from rotorwatch.errors import ConfigError, NotInStore, RotorwatchError
from rotorwatch.fleet.compare import Comparison
from rotorwatch.fleet.listing import NEWEST, Filters
from rotorwatch.report.html import POLICY as REPORT_POLICY
from rotorwatch.serve import comparison, names, pages
from rotorwatch.serve.flights import DIGEST, Flights, wrong
from rotorwatch.serve.live import Feed
from rotorwatch.serve.security import Guard, refused
from rotorwatch.serve.uploads import Limits, Refused, Uploads

MOST_ROWS, MOST_LETTERS = 200, 200  # rows of one answer; letters of a filter
FILTERS = tuple(field.name for field in fields(Filters))
UNKNOWN = "No such flight."
NO_DELETION = "This server does not delete flights; start it with --allow-delete, or use `rotorwatch fleet delete`."
# Scripts of a report are inline; in a sandbox they have no origin, and so no access to this server.
SANDBOX = f"{REPORT_POLICY}; frame-ancestors 'none'; base-uri 'none'; form-action 'none'; sandbox allow-scripts allow-downloads"
NAME = "x-rotorwatch-name"  # header with an upload's name; no page of another site may send it


def application(feed: Feed, flights: Flights, limits: Limits, host: str, token: str, allow_delete: bool = False) -> Any:
    """The ASGI application. feed: started and stopped with it. allow_delete: whether users of the page may delete flights."""

    def publish(row: dict[str, Any]) -> None:
        feed.hub.publish("flight", row)

    def trouble(text: str) -> None:
        feed.notify({"type": "error", "vehicle": "list", "text": text})

    @asynccontextmanager
    async def lifespan(_: Starlette):
        app.state.uploads = uploads = Uploads(flights, limits, publish, trouble)
        uploads.start()
        store_writer = flights.store_writer(publish, trouble)
        feed.ended = store_writer.keep
        feed.start()
        try:
            yield
        finally:
            await asyncio.to_thread(feed.stop)
            await asyncio.to_thread(store_writer.stop)
            uploads.stop()

    routes = [
        Route("/", _index),
        Route("/static/{name}", _file),
        Route("/favicon.ico", _icon),
        Route("/compare", _compare_page),
        Route("/flights/{digest}", _report),
        Route("/flights/{digest}/download", _download),
        Route("/api/about", _about),
        Route("/api/live", _live),
        Route("/api/flights", _list),
        Route("/api/flights", _upload, methods=["POST"]),
        Route("/api/flights/{digest}", _flight),
        Route("/api/flights/{digest}", _delete, methods=["DELETE"]),
        Route("/api/aircraft", _aircraft),
        Route("/api/compare", _compare),
    ]
    failures: dict[Any, Any] = {HTTPException: _failed, Refused: _not_taken, NotInStore: _not_known}
    failures |= dict.fromkeys((RotorwatchError, Exception), _broken)
    app = Starlette(routes=routes, lifespan=lifespan, exception_handlers=failures)
    app.state.feed, app.state.flights, app.state.limits, app.state.allow_delete = feed, flights, limits, allow_delete
    return Guard(app, host, token)


async def _index(_: Request) -> Response:
    return HTMLResponse(pages.index())


async def _file(request: Request) -> Response:
    content = pages.file(request.path_params["name"])
    if content is None:
        raise HTTPException(404)
    return Response(content[0], media_type=content[1], headers={"Cache-Control": "no-cache"})


async def _icon(_: Request) -> Response:
    return Response((pages.file("icon.svg") or (b"",))[0], media_type="image/svg+xml")


async def _about(request: Request) -> Response:
    state = request.app.state
    return JSONResponse({"version": __version__, "most": state.limits.most, "may_delete": state.allow_delete})


async def _live(request: Request) -> Response:
    after = request.headers.get("last-event-id", "")
    return StreamingResponse(request.app.state.feed.hub.follow(after), media_type="text/event-stream")


async def _list(request: Request) -> Response:
    query = dict(request.query_params)
    limit = _number(query.pop("limit", "50"), "limit", MOST_ROWS)
    offset = _number(query.pop("offset", "0"), "offset", 10**9)
    sort = query.pop("sort", "") or NEWEST
    query.pop("token", None)
    if unknown := sorted(query.keys() - FILTERS):
        raise HTTPException(
            400, f"{one_line(unknown[0], 40)} is not a filter{meant(unknown[0], FILTERS)}; choose from {', '.join(FILTERS)}."
        )
    filters = {name: text[:MOST_LETTERS] for name, text in query.items()}
    rows = request.app.state.flights.rows
    try:
        return JSONResponse(await asyncio.to_thread(rows, limit, offset, sort, **filters))
    except ConfigError as why:
        raise HTTPException(400, str(why)) from None


def _number(text: str, name: str, most: int) -> int:
    if not text.isascii() or not text.isdecimal() or len(text) > 10:
        raise HTTPException(400, f"{name} must be a whole number, 0 or more.")
    return min(int(text), most)


async def _upload(request: Request) -> Response:
    name = request.headers.get(NAME)
    if not name:
        raise HTTPException(400, "The header X-Rotorwatch-Name with the name of the log is missing.")
    length = request.headers.get("content-length")
    sent = request.stream()
    try:
        row, new = await request.app.state.uploads.take(name, int(length) if length else None, sent)
    except ClientDisconnect:
        return Response(status_code=499)
    return JSONResponse(row, 201 if new else 200)


async def _of_flight(request: Request, find: Callable[[str], Any]) -> Any:
    """The result of `find` for the flight of a request. Raises HTTPException."""
    digest = request.path_params["digest"]
    result = await asyncio.to_thread(find, digest) if DIGEST.fullmatch(digest) else None
    if result is None:
        raise HTTPException(404, UNKNOWN)
    return result


async def _flight(request: Request) -> Response:
    return JSONResponse(await _of_flight(request, request.app.state.flights.diagnosis))


async def _delete(request: Request) -> Response:
    state, digest = request.app.state, request.path_params["digest"]
    if not state.allow_delete:
        raise HTTPException(403, NO_DELETION)
    if not DIGEST.fullmatch(digest):
        raise HTTPException(404, UNKNOWN)
    try:
        row = await asyncio.to_thread(state.flights.delete, digest)
    except NotInStore:
        if state.uploads.waiting(digest):
            raise HTTPException(409, "This flight is being diagnosed; delete it once it is in the list.") from None
        raise HTTPException(404, UNKNOWN) from None
    state.feed.hub.publish("deleted", {"hash": digest})
    return JSONResponse(row)


async def _aircraft(request: Request) -> Response:
    return JSONResponse({"aircraft": await asyncio.to_thread(request.app.state.flights.aircraft)})


async def _compared(request: Request) -> Comparison:
    """The requested comparison. Raises HTTPException."""
    a, b = (request.query_params.get(name, "") for name in "ab")
    if not a or not b or a == b:
        raise HTTPException(400, "Choose two different flights to compare: /compare?a=HASH&b=HASH.")
    if not DIGEST.fullmatch(a) or not DIGEST.fullmatch(b):
        raise HTTPException(404, UNKNOWN)
    return await asyncio.to_thread(request.app.state.flights.compared, a, b)


async def _compare(request: Request) -> Response:
    return JSONResponse((await _compared(request)).to_dict())


async def _compare_page(request: Request) -> Response:
    return HTMLResponse(comparison.page(await _compared(request)))


async def _report(request: Request) -> Response:
    text = await _of_flight(request, request.app.state.flights.report)
    back = (
        '<body>\n<nav class="masthead" aria-label="rotorwatch"><a href="/">All flights</a> '
        f'<a href="/flights/{request.path_params["digest"]}/download">Download this report</a></nav>\n'
    )
    return HTMLResponse(text.replace("<body>\n", back, 1), headers={"Content-Security-Policy": SANDBOX})


async def _download(request: Request) -> Response:
    row = await _of_flight(request, request.app.state.flights.row)
    text = await _of_flight(request, request.app.state.flights.report)
    return HTMLResponse(text, headers={"Content-Security-Policy": SANDBOX, "Content-Disposition": names.attachment(row["name"])})


async def _failed(request: Request, why: Exception) -> Response:
    assert isinstance(why, HTTPException)
    standard = {404: "No such page.", 405: "This address does not accept such a request."}
    text = standard.get(why.status_code, "This request cannot be answered.")
    text = why.detail if why.detail and why.detail.endswith(".") else text
    answer = refused(request, why.status_code, text)
    answer.headers.update(why.headers or {})
    return answer


async def _not_taken(request: Request, why: Exception) -> Response:
    assert isinstance(why, Refused)
    return refused(request, why.code, str(why))


async def _not_known(request: Request, why: Exception) -> Response:
    return refused(request, 404, str(why))


async def _broken(request: Request, why: Exception) -> Response:
    return refused(request, *wrong(why))
