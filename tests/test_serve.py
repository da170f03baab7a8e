"""The served page without a browser: who may ask for what, uploads of every kind, the list of flights, and what pages receive."""

import asyncio
import contextlib
import json
import lzma
import math
import socket
import time
import types
from pathlib import Path
from urllib.parse import quote

import numpy as np
import pytest
from starlette.testclient import TestClient
from tests import misbehaving
from tests.conftest import hexa_diagnosis

from rotorwatch.commands import cli
from rotorwatch.errors import ConfigError, LinkError, StoreError, StoreFull
from rotorwatch.fleet.store import Entry
from rotorwatch.flight.diagnosis import Diagnosis
from rotorwatch.live.channels import metrics
from rotorwatch.live.watched import Watched
from rotorwatch.report.html import page
from rotorwatch.serve import connections, live, names, security, server, uploads
from rotorwatch.serve import flights as flights_of
from rotorwatch.serve.app import application
from rotorwatch.serve.flights import Flights
from rotorwatch.serve.hub import RECENT, Hub
from rotorwatch.serve.uploads import Limits, Refused, Uploads

SAMPLE = cli.SAMPLES / "quadx_healthy_hover.bin.xz"
TOKEN = "a-token-of-enough-letters"
HERE = "http://127.0.0.1:8000"


def guarded(tmp_path, token="", most=2 << 20, host="127.0.0.1"):
    flights = Flights(str(tmp_path / "fleet.db"))
    return application(live.Feed(), flights, Limits(most=most), host, token), flights


@pytest.fixture(scope="module")
def served(tmp_path_factory):
    """A client of a server that assesses what it is sent, small logs only."""
    app, flights = guarded(tmp_path_factory.mktemp("served"))
    with TestClient(app, HERE) as client:
        yield client, flights


@pytest.fixture
def closed(tmp_path):
    """A client of a server that wants a token; it is not started, so that nothing is assessed."""
    return TestClient(guarded(tmp_path, TOKEN)[0], HERE, follow_redirects=False)


def send(client, name, data, **headers):
    return client.post("/api/flights", content=data, headers={"X-Rotorwatch-Name": quote(name, safe=""), **headers})


# Names


@pytest.mark.parametrize(
    ("given", "shown"),
    [
        ("flight.bin", "flight.bin"),
        ("../../etc/passwd", "passwd"),
        ("..\\..\\boot.ini", "boot.ini"),
        ("C:\\logs\\7.bin", "7.bin"),
        ("..", "flight"),
        ("/", "flight"),
        ("%00%0d%0aSet-Cookie: x", "Set-Cookie: x"),
        ("a\u202egol.nib", "agol.nib"),
        ("<img src=x onerror=alert(1)>.bin", "<img src=x onerror=alert(1)>.bin"),
        ("%ff%fe.bin", "\ufffd\ufffd.bin"),
        ("  vol   été.ulg ", "vol été.ulg"),
    ],
)
def test_names_are_made_harmless(given, shown):
    assert names.shown(given if "%" in given else quote(given, safe="")) == shown
    on_disk = names.on_disk(shown)
    assert on_disk.startswith("log-") and on_disk.isascii() and not set(on_disk) & set("/\\<> \0")


def test_long_names_keep_their_ending():
    name = names.shown("x" * 5000 + ".bin.xz")
    assert len(name) <= names.MOST and names.shown("x" * 300 + ".bin.xz").endswith(".bin.xz")
    assert names.on_disk(names.shown("x" * 300 + ".bin.xz")).endswith(".bin.xz")


# Who may ask


def test_other_computers_need_a_token():
    assert security.checked("127.0.0.1", "") == security.checked("::1", "") == security.checked("localhost", "") == ""
    for host in ("0.0.0.0", "192.168.1.5", "::", "example.org"):
        with pytest.raises(ConfigError, match=r"--token"):
            security.checked(host, "")
        assert security.checked(host, TOKEN) == TOKEN
    for weak in ("short", "with a newline \n in it", "ümlaut-of-enough-letters"):
        with pytest.raises(ConfigError, match="at least 16"):
            security.checked("127.0.0.1", weak)


@pytest.mark.parametrize("path", ["/", "/api/flights", "/api/live", "/flights/" + 64 * "0", "/static/serve.js"])
def test_only_this_servers_names_are_answered(served, path):
    """A page of another site whose name is turned to this address would be of the same origin."""
    client, _ = served
    for host in ("evil.example", "evil.example:8000", "127.0.0.1.evil.example", "", "localhost@evil.example", "127.0.0.1:x", "[::1"):
        answer = client.get(path, headers={"Host": host})
        assert answer.status_code == 421 and "address" in answer.text
    if path != "/api/live":
        for host in ("localhost:8000", "127.0.0.1", "[::1]:8000", socket.gethostname()):
            assert client.get(path, headers={"Host": host}).status_code != 421


def test_other_sites_cannot_send(served):
    client, _ = served
    for headers in (
        {"Origin": "http://evil.example"},
        {"Origin": "null"},
        {"Sec-Fetch-Site": "cross-site"},
        {"Origin": "http://127.0.0.1:9"},
    ):
        answer = send(client, "a.bin", b"x", **headers)
        assert answer.status_code == 403 and "another site" in answer.json()["error"]


@pytest.mark.parametrize("origin", ["http://[", "http://[::1", "http://]", "null", ""])
def test_an_origin_that_is_no_address_is_another_site(served, origin):
    assert served[0].post("/api/flights", headers={"Origin": origin}).status_code == 403


def test_without_the_token_there_is_only_the_form(closed):
    for path in ("/", "/api/flights", "/api/live", "/static/serve.js", "/flights/" + 64 * "0", "/nothing"):
        answer = closed.get(path)
        assert answer.status_code == 401 and "token" in answer.text.lower()
        assert closed.get(path, headers={"Authorization": "Bearer wrong"}).status_code == 401
        assert closed.get(path, params={"token": "wrong-but-of-enough-letters"}).status_code == 401
        assert closed.get(path, headers={"Cookie": "rotorwatch-8000=wrong"}).status_code == 401
    assert 'type="password"' in closed.get("/").text and "script" not in closed.get("/").text
    assert send(closed, "a.bin", b"x").status_code == 401
    assert closed.get("/static/page.css").status_code == 200


def test_a_program_may_give_the_token_in_the_address(closed):
    for token, code in ((TOKEN, 400), ("wrong-but-of-enough-letters", 401)):  # 400: let in, but there is no name
        assert closed.post("/api/flights", params={"token": token}, content=b"x").status_code == code
    evil = {"Origin": "http://evil.example"}
    assert closed.post("/api/flights", params={"token": TOKEN}, content=b"x", headers=evil).status_code == 403


def test_the_token_opens(closed):
    assert closed.get("/api/flights", headers={"Authorization": f"Bearer {TOKEN}"}).status_code == 200
    assert closed.post("/login", data={"token": "wrong-but-of-enough-letters"}).status_code == 401
    assert closed.post("/login", content=b"x" * 9000).status_code == 413
    for let_in in (closed.get("/", params={"token": TOKEN, "a": "b"}), closed.post("/login", data={"token": TOKEN})):
        assert let_in.status_code == 303 and TOKEN not in str(let_in.headers)
        cookie = let_in.headers["set-cookie"].lower()
        assert "httponly" in cookie and "samesite=lax" in cookie
    assert closed.get("/").status_code == 200, "the cookie is kept by the client"
    closed.cookies.clear()
    assert send(closed, "a.bin", b"x", Authorization=f"Bearer {TOKEN[:-1]}").status_code == 401
    away = closed.get(HERE + "//evil.example/", params={"token": TOKEN})
    assert away.headers["location"].startswith("/") and not away.headers["location"].startswith("//")


@pytest.mark.parametrize("path", ["/", "/static/live.js", "/api/flights", "/nothing", "/flights/x", "/favicon.ico"])
def test_every_answer_binds_the_browser(served, path):
    headers = served[0].get(path).headers
    policy = headers["content-security-policy"]
    assert "default-src 'none'" in policy and "frame-ancestors 'none'" in policy and "unsafe" not in policy
    assert headers["x-content-type-options"] == "nosniff" and headers["x-frame-options"] == "DENY"


@pytest.mark.parametrize(
    "path",
    ["/static/../app.py", "/static/..%2fapp.py", "/static/%2e%2e/app.py", "/static//etc/passwd", "/flights/..%2f..%2ffleet.db",
     "/flights/x", "/flights/" + 63 * "0" + "A", "/api/flights/..", "/incoming/"],
)  # fmt: skip
def test_there_are_no_paths(served, path):
    answer = served[0].get(path)
    assert answer.status_code == 404 and "rotorwatch.serve" not in answer.text
    assert "No such page" in answer.text or "No such flight" in answer.text


def test_odd_questions_get_a_sentence(served):
    client, _ = served
    for ask in ("limit=x", "limit=-1", "offset=1e9", "limit=99999999999999999999"):
        assert "whole number" in client.get(f"/api/flights?{ask}").json()["error"]
    assert client.put("/api/flights").status_code == client.delete("/").status_code == 405
    assert "header" in client.post("/api/flights", content=b"x").json()["error"]


@pytest.mark.parametrize(("why", "code"), [
    (StoreFull("The disk of the store /srv/fleet.db is full."), 507),
    (StoreError("The store /srv/fleet.db cannot be opened."), 503),
    (PermissionError(13, "Permission denied", "/srv/fleet.db"), 507),
    (KeyError("/srv/fleet.db"), 500),
])  # fmt: skip
def test_no_answer_names_a_path_of_the_server(tmp_path, monkeypatch, capsys, why, code):
    app, flights = guarded(tmp_path)

    def failing(*_, **__):
        raise why

    monkeypatch.setattr(flights._store, "flights", failing)
    answer = TestClient(app, HERE, raise_server_exceptions=False).get("/api/flights")
    assert answer.status_code == code and "/srv" not in answer.text and answer.json()["error"].endswith(".")
    assert "/srv/fleet.db" in capsys.readouterr().err, "who runs the server is informed"


def test_a_flight_of_another_version_says_so(tmp_path, monkeypatch):
    app, flights = guarded(tmp_path)
    monkeypatch.setattr(flights._store, "flight", lambda digest: {"diagnosis": {"schema": 1}})
    answer = TestClient(app, HERE, raise_server_exceptions=False).get("/flights/" + 64 * "0")
    assert answer.status_code == 503 and "diagnose the log again" in answer.text


# Connections


@pytest.fixture(params=[""])
def listening(request, monkeypatch):
    """The port of a server of plain pages, with few and hasty connections; param: its token."""
    import threading

    from starlette.applications import Starlette
    from starlette.responses import PlainTextResponse
    from starlette.routing import Route

    async def slow(request):
        await asyncio.sleep(0.5)
        return PlainTextResponse("slow")

    async def plain(request):
        return PlainTextResponse("here")

    monkeypatch.setattr(connections, "HEADER_S", 0.4)
    monkeypatch.setattr(connections, "PER_ADDRESS", 8)
    sock, begun, hub = server.listen("127.0.0.1", 0), threading.Event(), Hub(dict)
    feed = types.SimpleNamespace(hub=hub)
    app = Starlette(routes=[Route("/", plain, methods=["GET", "POST"]), Route("/slow", slow, methods=["GET", "POST"])])
    serving = server.http_server(security.Guard(app, "127.0.0.1", request.param), begun.set, feed.hub.close)
    serving.config.lifespan = "off"
    thread = threading.Thread(target=lambda: asyncio.run(serving.serve([sock])), daemon=True)
    thread.start()
    assert begun.wait(10)
    yield sock.getsockname()[1]
    serving.should_exit = True
    thread.join(10)
    sock.close()


def connected(port, text=b""):
    sock = socket.create_connection(("127.0.0.1", port), 5)
    sock.sendall(text)
    return sock


def answered(sock):
    """All that comes until the other side closes."""
    text = b""
    with contextlib.suppress(ConnectionError):
        while piece := sock.recv(4096):
            text += piece
    return text


ASK = b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n"


def test_connections_without_a_request_lock_nobody_out(listening):
    idle = [connected(listening, ASK) for _ in range(40)]
    began = time.monotonic()
    assert b"200" in answered(connected(listening, ASK + b"Connection: close\r\n\r\n"))
    assert time.monotonic() - began < 0.3, "it need not wait for the others to be given up"
    for sock in idle:
        assert answered(sock) == b""


@pytest.mark.parametrize("first", [
    ASK,  # a header that never ends
    ASK + b"\r\n" + ASK,  # so for the second request of a connection
    b"POST / HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 999\r\n\r\n",  # answered, and its body never ends
])  # fmt: skip
def test_a_drop_now_and_then_keeps_no_connection(listening, first):
    sock, began = connected(listening, first), time.monotonic()
    sock.settimeout(0.05)
    closed = False
    while not closed and time.monotonic() - began < 3.0:
        try:
            closed = not sock.recv(4096)
        except TimeoutError:
            with contextlib.suppress(ConnectionError):
                sock.sendall(b"x")
        except ConnectionError:
            closed = True
    assert 0.3 < time.monotonic() - began < 1.5


@pytest.mark.parametrize("listening", [TOKEN], indirect=True)
def test_forms_for_the_token_that_do_not_end_lock_nobody_out(listening):
    """Nor do they end an upload of somebody who is let in."""
    head = b"POST %s HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 5\r\n"
    upload = connected(listening, head % b"/slow" + b"Authorization: Bearer %s\r\nConnection: close\r\n\r\nb" % TOKEN.encode())
    time.sleep(0.1)
    slow = []
    for _ in range(12):
        slow.append(connected(listening, head % b"/login" + b"\r\nt"))
        time.sleep(0.01)  # until it is under way
    for _ in range(10):
        assert b" 401 " in answered(connected(listening, ASK + b"Connection: close\r\n\r\n"))
    upload.sendall(b"odys")
    assert b"slow" in answered(upload)
    for sock in slow:
        sock.close()


def test_one_address_has_so_many_requests_at_once(listening):
    busy = [connected(listening, ASK.replace(b"/", b"/slow", 1) + b"Connection: close\r\n\r\n") for _ in range(8)]
    time.sleep(0.1)
    assert b"503" in answered(connected(listening, ASK + b"\r\n"))
    assert all(b"slow" in answered(sock) for sock in busy), "longer than a header may take"
    assert b"200" in answered(connected(listening, ASK + b"Connection: close\r\n\r\n"))


def test_the_form_for_the_token_is_given_up_when_it_does_not_end(tmp_path, monkeypatch):
    monkeypatch.setattr(security, "FORM_S", 0.05)
    sent = []

    async def receive():
        if sent:
            await asyncio.sleep(5.0)
        sent.append(1)
        return {"type": "http.request", "body": b"token=", "more_body": True}

    async def answer(message):
        sent.append(message)

    scope = {
        "type": "http", "method": "POST", "path": "/login", "query_string": b"", "headers": [(b"host", b"127.0.0.1:8000")],
        "scheme": "http", "server": ("127.0.0.1", 8000), "client": ("127.0.0.1", 1), "http_version": "1.1", "root_path": "",
    }  # fmt: skip
    asyncio.run(asyncio.wait_for(guarded(tmp_path, TOKEN)[0](scope, receive, answer), 2.0))
    assert sent[1]["status"] == 408


# Uploads


def test_a_log_is_assessed_and_kept(served):
    client, flights = served
    hostile = '"><script>alert(1)</script>'
    answer = send(client, hostile + ".bin.xz", SAMPLE.read_bytes())
    row = answer.json()
    assert answer.status_code == 201, row
    assert row["verdict"] == "healthy" and row["frame"] == "ardupilot-quad-x"
    name = "script>.bin.xz"  # what is left of it behind the last slash
    assert row["name"] == name

    again = send(client, "renamed.bin.xz", SAMPLE.read_bytes())
    named = {"name": "renamed.bin.xz", "known_as": row["name"]}
    assert again.status_code == 200 and again.json() == row | named, "whoever sends it finds the own name"
    assert client.get("/api/flights", params={"search": "quad HEALTHY"}).json() == {"total": 1, "flights": [row]}
    assert client.get("/api/flights", params={"search": "hexa"}).json() == {"total": 0, "flights": []}
    assert client.get(f"/api/flights/{row['hash']}").json()["flight"]["name"] == name

    report = client.get(f"/flights/{row['hash']}")
    assert "sandbox allow-scripts" in report.headers["content-security-policy"]
    assert "default-src 'none'" in report.headers["content-security-policy"]
    assert "script&gt;.bin.xz" in report.text and "<b>script>" not in report.text and 'href="/"' in report.text

    flights.page(row["hash"]).unlink()  # as of a flight that came into the store another way
    assert "script&gt;.bin.xz" in client.get(f"/flights/{row['hash']}").text
    assert not [p for p in flights.folder("incoming").glob("run-*/*") if p.name != "lock"], "no upload is left behind"


BROKEN = {
    "notes.txt": (lambda: b"Dear diary, today I flew.\n" * 50, 422, "not a flight log"),
    "empty.bin": (lambda: b"", 400, "is empty"),
    "bomb.bin.xz": (lambda: lzma.compress(bytes(400 << 20), preset=0), 422, "decompresses to more"),
    "short.bin": (lambda: lzma.decompress(SAMPLE.read_bytes())[:3000], 422, "holds no flight"),
    "big.bin": (lambda: bytes((2 << 20) + 1), 413, "--max-upload"),
}  # fmt: skip


@pytest.mark.parametrize("name", BROKEN)
def test_what_is_no_flight_gets_one_sentence(served, name):
    client, flights = served
    made, code, sentence = BROKEN[name]
    data = made()
    before = client.get("/api/flights").json()["total"]
    without_length = [] if len(data) > 30_000 and code != 413 else [iter([data[:1000], data[1000:]])]
    for given in (data, *without_length):
        answer = send(client, name, given)
        text = answer.json()["error"]
        assert answer.status_code == code and sentence in text and text.startswith(name), text
        assert str(flights.folder("incoming")) not in text and "log-" not in text and "Traceback" not in text
    assert client.get("/api/flights").json()["total"] == before


def test_a_truncated_log_is_read_as_far_as_it_goes(served):
    answer = send(served[0], "cut.bin.xz", SAMPLE.read_bytes()[:300_000])
    assert answer.status_code == 201 and answer.json()["duration_s"] > 10.0
    found = served[0].get(f"/api/flights/{answer.json()['hash']}").json()
    assert any("ends early" in warning for warning in found["warnings"])


async def body(*pieces, pause=0.0):
    for piece in pieces:
        await asyncio.sleep(pause)
        yield piece


def take(flights, limits, *pieces, pause=0.0, reported=None):
    async def run():
        here = Uploads(flights, limits, reported or (lambda row: None))
        try:
            return await here.take("a.bin", None, body(*pieces, pause=pause))
        finally:
            here.stop()

    return asyncio.run(run())


def test_a_slow_upload_is_given_up(tmp_path, monkeypatch):
    monkeypatch.setattr(uploads, "IDLE_S", 0.02)
    flights = Flights(str(tmp_path / "fleet.db"))
    with pytest.raises(Refused, match="too slow") as why:
        take(flights, Limits(), b"a", b"b", pause=5.0)
    assert why.value.code == 408
    assert not list(flights.folder("incoming").glob("run-*/*/*"))


@pytest.mark.parametrize(("job", "limits", "sentence"), [
    (misbehaving.endless, Limits(assess_s=0.2), "exceeded 0.2 s"),
    (misbehaving.greedy, Limits(memory_mb=500), "exceeded 500 MB of memory"),
])  # fmt: skip
def test_a_log_that_takes_too_much_is_given_up(tmp_path, monkeypatch, job, limits, sentence):
    monkeypatch.setattr(uploads, "assess", job)
    monkeypatch.setattr(uploads, "LOADS", ())
    with pytest.raises(Refused, match=sentence) as why:
        take(Flights(str(tmp_path / "fleet.db")), limits, b"a")
    assert why.value.code == 422 and str(why.value).startswith("a.bin: ")


def test_what_a_killed_server_had_received_is_assessed_by_the_next(tmp_path):
    flights = Flights(str(tmp_path / "fleet.db"))
    killed = flights.folder("incoming") / "run-killed" / "one"
    killed.mkdir(parents=True)
    (killed / "log-a.bin").write_bytes(b"x")
    (killed / "complete.json").write_text(json.dumps({"name": "a.bin", "file": "../log-a.bin", "digest": 64 * "0", "size": 1}))
    (killed.parent / "half").mkdir()
    (killed.parent / "half" / "log-b.bin").write_bytes(b"x")
    (killed.parent / "lock").touch()
    own, lock = uploads._own(flights.folder("incoming"))
    other, _held = uploads._own(flights.folder("incoming"))  # of a server that runs
    (log,) = uploads._left(flights.folder("incoming"), own)
    assert log.path == own / "one" / "log-a.bin" and log.path.read_bytes() == b"x" and log.name == "a.bin"
    assert not killed.parent.exists() and other.exists()
    lock.close()


def kept(flights):
    """Names of the logs that wait for being assessed."""
    return sorted(json.loads(note.read_text())["name"] for note in flights.folder("incoming").glob("run-*/*/complete.json"))


def run_uploads(flights, action, reported=lambda row: None, trouble=lambda text: None, limits=None):
    """What `action(uploads)` comes to while a server takes uploads."""

    async def run():
        here = Uploads(flights, limits or Limits(), reported, trouble)
        here.start()
        try:
            return await action(here)
        finally:
            here.stop()

    return asyncio.run(run())


async def until(condition):
    for _ in range(1000):
        if condition():
            return
        await asyncio.sleep(0.01)
    raise AssertionError("it did not happen within 10 s")


@pytest.fixture
def quick(tmp_path, monkeypatch):
    """Flights that are assessed at once, and what a failure is tried again after."""
    monkeypatch.setattr(uploads, "assess", misbehaving.while_full)
    monkeypatch.setattr(uploads, "LOADS", ())
    monkeypatch.setattr(uploads, "AGAIN_S", 0.05)
    return Flights(str(tmp_path / "fleet.db"))


def test_a_full_disk_keeps_the_log_until_there_is_room(quick, monkeypatch):
    full = quick.page("full").with_suffix("")
    full.touch()
    rows, said = [], []

    async def action(here):
        with pytest.raises(Refused, match=r"^a\.bin: .*free some space") as why:
            await here.take("a.bin", None, body(b"a log"))
        assert why.value.code == 507 and "kept" in str(why.value) and str(quick.folder("")) not in str(why.value)
        assert kept(quick) == ["a.bin"] and quick.rows(10)["total"] == 0
        full.unlink()
        await until(lambda: rows)

    run_uploads(quick, action, rows.append, said.append)
    assert [row["name"] for row in rows] == ["a.bin"] and quick.rows(10)["total"] == 1
    assert kept(quick) == [] and any("a.bin" in text and "free some space" in text for text in said)


@pytest.mark.parametrize(("why", "code"), [
    (StoreFull("The disk of the store /srv/fleet.db is full."), 507),
    (StoreError("Another program has kept the store /srv/fleet.db busy."), 503),
    (ValueError("a bug at /srv/fleet.db"), 500),
])  # fmt: skip
def test_what_the_store_does_not_take_is_kept_and_tried_again(quick, monkeypatch, why, code):
    keep, failures = quick._store.add, [why, why, why]
    monkeypatch.setattr(quick._store, "add", lambda entry: failing(failures.pop()) if failures else keep(entry))

    def failing(why):
        raise why

    rows, said = [], []

    async def refused(here):
        with pytest.raises(Refused, match="kept and diagnosed later") as refusal:
            await here.take("a.bin", None, body(b"a log"))
        assert refusal.value.code == code and "/srv" not in str(refusal.value)

    async def action(here):
        await refused(here)
        await until(lambda: rows)

    monkeypatch.setattr(uploads, "AGAIN_S", 60.0)
    run_uploads(quick, refused)
    assert kept(quick) == ["a.bin"]
    monkeypatch.setattr(uploads, "AGAIN_S", 0.02)
    run_uploads(quick, action, rows.append, said.append)  # as soon as it starts; sent again; later by itself
    assert kept(quick) == [] and [row["name"] for row in rows] == ["a.bin"] and "/srv" not in "".join(said)


def test_a_log_that_waits_is_assessed_at_once_when_it_is_sent_again(quick, monkeypatch):
    monkeypatch.setattr(uploads, "AGAIN_S", 60.0)
    full = quick.page("full").with_suffix("")
    full.touch()

    async def action(here):
        with pytest.raises(Refused):
            await here.take("a.bin", None, body(b"a log"))
        full.unlink()
        return await here.take("again.bin", None, body(b"a log"))

    row, new = run_uploads(quick, action)
    assert new and (row["name"], row["known_as"]) == ("again.bin", "a.bin") and kept(quick) == []


def test_stopping_a_server_leaves_what_it_assesses_to_the_next(quick, monkeypatch):
    monkeypatch.setattr(uploads, "assess", misbehaving.endless)

    async def action(here):
        sent = asyncio.create_task(here.take("a.bin", None, body(b"a log")))
        await until(lambda: here._workers._all and here._workers._all[0].ready)
        here.stop()
        await asyncio.wait([sent])
        why = sent.exception()
        assert isinstance(why, Refused) and why.code == 503 and "stopping" in str(why)

    run_uploads(quick, action)
    assert kept(quick) == ["a.bin"]
    monkeypatch.setattr(uploads, "assess", misbehaving.while_full)
    rows = []
    run_uploads(quick, lambda here: until(lambda: rows), rows.append)
    assert [row["name"] for row in rows] == ["a.bin"] and kept(quick) == []


def test_what_a_next_start_cannot_take_over_stays(quick, monkeypatch):
    left = quick.folder("incoming") / "run-killed" / "one"
    left.mkdir(parents=True)
    (left / "log-a.bin").write_bytes(b"x")
    (left / "complete.json").write_text(json.dumps({"name": "a.bin", "file": "log-a.bin", "digest": 64 * "0", "size": 1}))
    (left.parent / "lock").touch()

    def full(*_):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(Path, "rename", full)
        run_uploads(quick, lambda here: asyncio.sleep(0))
    assert kept(quick) == ["a.bin"]
    run_uploads(quick, lambda here: until(lambda: quick.rows(10)["total"] and not kept(quick)))
    assert kept(quick) == []


def test_a_process_that_dies_once_refuses_no_log(quick, monkeypatch):
    monkeypatch.setattr(uploads, "assess", misbehaving.dies_once)
    row, new = run_uploads(quick, lambda here: here.take("a.bin", None, body(b"a log")))
    assert new and row["name"] == "a.bin"


def test_many_uploads_at_once_wait_for_their_turn(quick):
    async def action(here):
        sent = (here.take(f"{n}.bin", None, body(b"log %d" % n, pause=0.005)) for n in range(200))
        return await asyncio.gather(*sent, return_exceptions=True)

    answers = run_uploads(quick, action)
    assert [one for one in answers if isinstance(one, Exception)] == []
    assert quick.rows(1)["total"] == 200


def test_who_has_waited_too_long_for_a_turn_is_reported_so(quick, monkeypatch):
    monkeypatch.setattr(uploads, "PATIENCE_S", 0.05)
    monkeypatch.setattr(uploads, "RECEIVING", 1)

    async def action(here):
        slow = asyncio.create_task(here.take("slow.bin", None, body(b"a", pause=1.0)))
        await asyncio.sleep(0)
        with pytest.raises(Refused, match="try again in a minute") as why:
            await here.take("b.bin", None, body(b"b"))
        assert why.value.code == 503
        slow.cancel()

    run_uploads(quick, action)


def test_a_page_that_cannot_be_written_is_no_fault_of_the_log(served, monkeypatch):
    client, flights = served
    monkeypatch.setattr(flights, "page", lambda digest: flights.folder("incoming") / "gone" / "page.html")
    answer = send(client, "room.bin.xz", SAMPLE.read_bytes()[:250_000])
    assert answer.status_code == 507 and str(flights.folder("")) not in answer.text and "free some space" in answer.text
    assert kept(flights) == ["room.bin.xz"]


# The answer from its JSON


def test_an_answer_is_made_of_its_json_again():
    reported = hexa_diagnosis().to_dict()
    again = Diagnosis.from_dict(json.loads(json.dumps(reported)))
    assert again.to_json() == json.dumps(reported, indent=1)
    assert "rotor 3" in page(again)
    with pytest.raises(ConfigError, match="diagnose the log again"):
        Diagnosis.from_dict({**reported, "schema": 1})


# What pages receive


def frames(text):
    """(identity, kind, data) of each event of a stream."""
    found = []
    for block in text.split("\n\n"):
        lines = dict(line.split(": ", 1) for line in block.splitlines() if ": " in line and not line.startswith(":"))
        if "event" in lines:
            found.append((lines["id"], lines["event"], json.loads(lines["data"])))
    return found


def reported(hub, after=""):
    """What somebody hears at once who comes with the identity of the last message that he has."""

    async def run():
        text, stream = "", hub.follow(after)
        try:
            while True:
                text += await asyncio.wait_for(anext(stream), 0.05)
        except asyncio.TimeoutError:  # not the built-in one in Python 3.10
            pass
        await stream.aclose()
        return text

    return frames(asyncio.run(run()))


def test_who_comes_back_hears_what_he_missed_and_no_more():
    hub = Hub(lambda: {"all": True})
    for number in range(5):
        hub.publish("tick", number)
    ((last, kind, data),) = reported(hub)
    assert (kind, data) == ("state", {"all": True})
    hub.publish("tick", 5)
    hub.publish("tick", 6)
    assert [(kind, data) for _, kind, data in reported(hub, last)] == [("tick", 5), ("tick", 6)]
    for stale in ("elsewhere-3", "x", last + "9" * 12, last.split("-")[0] + "-"):
        assert [kind for _, kind, _ in reported(hub, stale)] == ["state"]
    for number in range(RECENT + 1):
        hub.publish("tick", number)
    assert [kind for _, kind, _ in reported(hub, last)] == ["state"], "too much was missed"


def test_a_stream_ends_when_the_server_does():
    async def run():
        hub = Hub(dict)
        stream = hub.follow()
        await anext(stream), await anext(stream)
        asyncio.get_running_loop().call_later(0.01, hub.close)
        return [text async for text in stream]

    assert asyncio.run(asyncio.wait_for(run(), 5.0)) == []


def test_a_long_flight_stays_in_view():
    band, one = live.Band(), (np.zeros(4), np.zeros(4), np.full(4, 0.1))
    for k in range(20_000):
        band.add(0.2 * k, None if 500 < k < 510 else one)
    times = [row[0] for row in band.rows]
    assert len(band.rows) < 2 * live.POINTS and times[0] == 0.0 and times[-1] > 3990.0
    assert sum(len(row) == 1 for row in band.rows) == 1, "one gap where nothing was assessed"


class Failing:
    """A source that breaks."""

    def __init__(self, why):
        self.vehicles, self._why = (Watched("v", lambda alert: None),), why

    def poll(self, wait_s):
        raise self._why

    def shown(self):
        return [(self.vehicles[0], "parameters")]

    def leave(self):
        raise self._why


@pytest.mark.parametrize("why", [LinkError("the cable is out."), ValueError("bug")])
def test_a_source_that_breaks_takes_nothing_with_it(why):
    """What a source says of itself ends it; after an error of rotorwatch's own it is tried again until the server is stopped."""
    feed = live.Feed()
    feed._sources = [live.Guarded("serial:x:1", Failing(why), feed)]
    feed.start()
    feed._thread.join(0.3 if isinstance(why, ValueError) else 10.0)
    assert feed._thread.is_alive() == isinstance(why, ValueError)
    feed.stop()
    state = feed.state()
    text = state["endpoints"][0]["text"]
    assert str(why) in text and text.endswith((".", "report it"))
    assert state["said"][-1]["text"] == text and state["vehicles"][0]["blind"] == "waiting for parameters"
    json.dumps(state, allow_nan=False)


# The command


def test_bad_beginnings_are_one_sentence(run, tmp_path):
    taken = server.listen("127.0.0.1", 0)
    port = taken.getsockname()[1]
    store = ("--store", tmp_path / "fleet.db")
    for arguments, sentence in (
        (("--port", port), "another program uses this port"),
        (("--host", "0.0.0.0"), "--token"),
        (("--token", "short"), "at least 16"),
        (("--token", TOKEN, "--host", "no.such.host.invalid"), "not an address of this computer"),
        (("--port", 0, "missing.bin"), "no such log"),
        (("--port", 0, "udp:99999"), "not an endpoint"),
        (("--port", 0, "--max-upload", -1), "above zero"),
        (("--port", 0, "--speed", "fast"), "above 0, or max"),
        (("--port", 0, "--store", tmp_path), "is a folder"),
    ):
        code, out, err = run("serve", *store, *arguments)
        assert code == 2 and out == "" and sentence in err and len(err.strip().splitlines()) == 1, (arguments, err)
    taken.close()


def test_the_names_of_the_api_are_those_of_the_command():
    import inspect

    options = {p.name for p in cli.cli.commands["serve"].params} - {"quiet", "debug"}
    assert options - {"help"} == set(inspect.signature(server.serve).parameters) - {"ready"}
    assert math.isfinite(inspect.signature(server.serve).parameters["max_upload"].default)


def test_a_flight_heard_over_a_link_is_listed_when_it_has_ended(tmp_path):
    """As heard from a log here: which source it is makes no difference to what is assessed."""
    flights, rows = Flights(str(tmp_path / "fleet.db")), []
    store_writer = flights.store_writer(rows.append, pytest.fail)
    feed = live.Feed(store_writer.keep)
    feed.open(str(SAMPLE.with_name("hexax_m3_mul0.80_square_wind.bin.xz")), None, math.inf, None, True)
    feed._sources[0].lists = True
    feed.start()
    feed._thread.join(120)
    feed.stop()
    store_writer.stop()
    (row,) = rows
    assert row["verdict"] == "fault" and "rotor 3" in row["headline"].lower() and row["frame"] == "ardupilot-hexa-x"
    found = Diagnosis.from_dict(flights.diagnosis(row["hash"]))
    assert found.rotors[2].status == "degraded" and found.events[found.main].rotors == (3,)
    assert "diagnosed in flight" in found.assumptions[-1] and "rotor 3" in flights.report(row["hash"])
    state = feed.state()["vehicles"][0]
    assert state["named"] == [3] and state["looks"][2][0] == live.colours.FAULT and len(state["points"]) > 50


@pytest.mark.parametrize("name, verdict, words", [("quad-off-1", "fault", "Rotor 2"), ("disarmed-1", "crashed", "Not a rotor fault")])
def test_a_crash_that_was_watched_is_lost_on_the_page_and_listed_as_a_crash(tmp_path, name, verdict, words):
    crash = Path(__file__).parents[2] / "shared" / "flights" / "crash" / f"{name}.bin.xz"
    if not crash.exists():
        pytest.skip(f"the shared flight {name} is not here")
    flights, rows = Flights(str(tmp_path / "fleet.db")), []
    store_writer = flights.store_writer(rows.append, pytest.fail)
    feed = live.Feed(store_writer.keep)
    feed.open(str(crash), None, math.inf, None, True)
    feed._sources[0].lists = True
    feed.start()
    feed._thread.join(120)
    feed.stop()
    store_writer.stop()
    (row,) = [r for r in rows if "departed controlled flight" in r["headline"]]
    assert row["verdict"] == verdict and words in row["headline"]
    found = Diagnosis.from_dict(flights.diagnosis(row["hash"]))
    assert len(found.story) >= 3 and "departed controlled flight" in flights.report(row["hash"])
    state = feed.state()["vehicles"][0]
    assert state["state"] == "LOST" and any(e["kind"] == "fault" and "loss of control" in e["text"] for e in state["events"])


def test_the_page_has_a_word_for_every_state():
    page = (Path(live.__file__).parent / "page" / "live.js").read_text("utf-8")
    assert all(f"  {state}: [" in page for state in metrics.STATES)


@pytest.mark.parametrize("why", [StoreError("The database /srv/fleet.db cannot be reached."), OSError("/srv/fleet.db")])
def test_a_store_that_cannot_be_reached_is_tried_again(tmp_path, why, monkeypatch):
    class Gone:
        def __init__(self):
            self.times = 0

        def keep(self, entry):
            self.times += 1
            if self.times == 1:
                raise why
            return {"hash": entry.hash}

    monkeypatch.setattr(flights_of, "AGAIN_S", 0.01)
    rows, said = [], []
    store_writer = flights_of.StoreWriter(Gone(), rows.append, said.append, tmp_path)
    store_writer.keep(Entry("0" * 64, "", "udp:1/1", 0))
    for _ in range(500):
        if not rows:
            store_writer._thread.join(0.01)
    store_writer.stop()
    assert rows == [{"hash": "0" * 64}] and "udp:1/1 is not in the list yet" in said[0] and "/srv/fleet.db" not in said[0]
