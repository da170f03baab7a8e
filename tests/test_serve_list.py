"""What the served page asks for its list: filters and orders, two flights compared, reports as files, deletion."""

import asyncio
import re
from dataclasses import replace
from email.message import Message
from urllib.parse import quote

import pytest
from starlette.testclient import TestClient
from tests.conftest import hexa_diagnosis
from tests.test_serve import HERE, SAMPLE, TOKEN, guarded, send

from rotorwatch.errors import StoreError
from rotorwatch.fleet.store import Entry
from rotorwatch.serve import live, names
from rotorwatch.serve.app import application
from rotorwatch.serve.flights import Flights
from rotorwatch.serve.uploads import Limits

FAULT, HEALTHY, OLD, NONE = (digit * 64 for digit in "abcd")


def fill(flights):
    """Three flights; the first has a report that was written, the last an answer of a version that nobody understands."""
    found = hexa_diagnosis()
    well = replace(found, verdict="healthy", headline="Nothing was found.", events=(), main=None,
                   rotors=tuple(replace(r, loss=0.0, interval=(0.0, 0.05), status="healthy") for r in found.rotors))  # fmt: skip
    for hash, name, answer, utc, duration in (
        (FAULT, 'a "b" <i>.bin.xz', found, "2026-05-01T10:00:00.000Z", 60.0),
        (HEALTHY, "well.bin", well, "2026-05-02T10:00:00.000Z", 600.0),
        (OLD, "old.bin", None, None, 5.0),
    ):
        reported = answer.to_dict() if answer else {"schema": 1}
        flights.keep(Entry(
            hash, "", name, 1, identity="uid 1" if answer else "", called="Quad <7>", utc=utc, duration_s=duration, frame="hexa X",
            rotors=6, verdict=reported.get("verdict", "inconclusive"), headline=reported.get("headline", ""), diagnosis=reported,
            trim={"voltage": 12.0},
        ))  # fmt: skip
    flights.page(FAULT).write_text("<html><body>\nas it was written</body></html>")


@pytest.fixture
def made(tmp_path):
    """A server that may delete, and its flights."""
    flights = Flights(str(tmp_path / "fleet.db"))
    fill(flights)
    app = application(live.Feed(), flights, Limits(), "127.0.0.1", "", allow_delete=True)
    with TestClient(app, HERE) as client:
        yield client, flights, app._app.state.feed.hub


@pytest.fixture(scope="module")
def read(tmp_path_factory):
    """A client of a server that deletes nothing; it is not started."""
    app, flights = guarded(tmp_path_factory.mktemp("read"))
    fill(flights)
    return TestClient(app, HERE)


# Filters and orders


@pytest.mark.parametrize(
    ("ask", "wanted"),
    [
        ("", [HEALTHY, FAULT, OLD]),
        ("sort=-loss", [FAULT, HEALTHY, OLD]),
        ("sort=duration&limit=1", [OLD]),
        ("sort=duration&limit=1&offset=1", [FAULT]),
        ("verdict=fault,healthy&sort=date", [FAULT, HEALTHY]),
        ("aircraft=Quad+%3C7%3E&since=2026-05-02", [HEALTHY]),
        ("until=2026-05-01", [FAULT]),
        ("min_loss=0.1&min_duration=10", [FAULT]),
        ("search=w%25l", []),
        ("search=w_ll", []),
        ("search=&verdict=&aircraft=&since=&until=&min_loss=&min_duration=&sort=", [HEALTHY, FAULT, OLD]),
        (f"search={'x' * 5000}", []),
        ("limit=9999999999", [HEALTHY, FAULT, OLD]),
        ("limit=0", []),
        ("offset=999999999", []),
        ("token=of-a-program", [HEALTHY, FAULT, OLD]),
    ],
)
def test_the_list_is_what_was_asked_for(read, ask, wanted):
    answer = read.get(f"/api/flights?{ask}")
    found = answer.json()
    assert answer.status_code == 200 and [f["hash"] for f in found["flights"]] == wanted
    assert found["total"] >= len(wanted)


def test_a_row_says_how_much_and_when(read):
    row = read.get("/api/flights?verdict=fault").json()["flights"][0]
    answer = read.get(f"/api/flights/{FAULT}").json()
    main = answer["events"][answer["main_event"]]
    assert row["loss"] == max(main["loss"]) > 0.3 and row["onset_s"] == main["onset_s"]
    assert read.get("/api/aircraft").json()["aircraft"][0] | {"key": ""} == {"key": "", "name": "Quad <7>", "flights": 2}


@pytest.mark.parametrize(
    ("ask", "code", "says"),
    [
        ("sort=size", 400, "sort size: choose from date"),
        ("sort=f.utc%3BDROP+TABLE+flights", 400, "choose from"),
        ("sort=-", 400, "choose from"),
        ("verdict=broken", 400, "choose from healthy"),
        ("since=1.5.2026", 400, "give a day"),
        ("until=%00", 400, "give a day"),
        ("min_loss=1e999", 400, "0.1 for 10 %"),
        ("min_duration=-1", 400, "such as 60"),
        ("verdicts=fault", 400, "verdicts is not a filter (did you mean verdict?); choose from search, verdict"),
        ("limit=1.5", 400, "whole number"),
        ("aircraft=nobody", 404, "has no aircraft nobody"),
        (f"aircraft=a%0Ab%1B%00{'x' * 500}", 404, "has no aircraft a b"),
    ],
)
def test_what_cannot_be_asked_gets_a_code_and_a_sentence(read, ask, code, says):
    answer = read.get(f"/api/flights?{ask}")
    text = answer.json()["error"]
    assert answer.status_code == code and says in text and text.endswith(".") and "\n" not in text and len(text) < 250


# Comparison


def test_two_flights_are_compared(read):
    found = read.get(f"/api/compare?a={FAULT}&b={HEALTHY}").json()
    assert found["headline"] == "They differ in verdict, rotor 3 (front left) and events."
    rows = {row["what"]: row for row in found["facts"] + found["rotors"]}
    assert rows["verdict"] == {"what": "verdict", "values": ["Fault found", "Healthy"], "differs": True}
    assert rows["battery in hover"]["values"] == ["12.0 V", "12.0 V"] and not rows["duration"]["differs"]
    assert [len(events) for events in found["events"]] == [1, 0] and found["events"][0][0]["alone"]

    page = read.get(f"/compare?a={FAULT}&b={HEALTHY}")
    onset = found["events"][0][0]["onset_s"]
    assert page.status_code == 200 and f'href="/flights/{FAULT}#t={onset:.2f}"' in page.text
    assert page.text.count('class="airframe"') == 2 and " style=" not in page.text, "the policy allows no styles inside"
    assert "<i>" not in page.text and "&lt;i&gt;.bin.xz" in page.text and "Quad &lt;7&gt;" in page.text
    ids = re.findall(r' id="([^"]+)"', page.text)
    assert len(ids) == len(set(ids))


@pytest.mark.parametrize("path", ["/compare", "/api/compare"])
@pytest.mark.parametrize(
    ("ask", "code"),
    [
        ("", 400),
        (f"?a={FAULT}", 400),
        (f"?a={FAULT}&b={FAULT}", 400),
        (f"?a={FAULT}&b={NONE}", 404),
        (f"?a={FAULT}&b=..%2f..%2ffleet.db", 404),
        (f"?a={FAULT[:8]}&b={HEALTHY}", 404),
        (f"?a={FAULT}&b={OLD}", 503),
    ],
)
def test_what_cannot_be_compared_gets_a_code_and_a_sentence(read, path, ask, code):
    answer = read.get(path + ask)
    assert answer.status_code == code
    text = answer.json()["error"] if path.startswith("/api") else re.sub("<[^>]+>", " ", answer.text)
    assert {400: "Choose two different flights", 404: "flight", 503: "diagnose the log again"}[code] in text


# Reports as files


@pytest.mark.parametrize(
    ("log", "plain", "whole"),
    [
        ("flight.bin", "flight", "flight"),
        ("00000012.BIN.xz", "00000012", "00000012"),
        ("2026-05-01 12.30.15.bin", "2026-05-01 12.30.15", "2026-05-01 12.30.15"),
        ("vol été.ulg", "vol _t_", "vol été"),
        ('a"; filename="b.exe', "a__ filename__b", "a_; filename=_b"),
        ("../../etc/passwd", "passwd", "passwd"),
        ("C:\\x\\y.bin", "y", "y"),
        ("a\r\nSet-Cookie: x.bin", "a Set-Cookie_ x", "a Set-Cookie_ x"),
        ("a\u202egol.nib", "agol", "agol"),
        (".bin", "flight", "flight"),
        ("", "flight", "flight"),
        ("x" * 500 + ".bin", None, None),
    ],
)
def test_a_report_is_saved_by_a_safe_name(log, plain, whole):
    header = names.attachment(log)
    assert header.isascii() and header.isprintable() and len(header) < 1500
    message = Message()
    message["Content-Disposition"] = header.replace("filename*=", "other*=")
    assert message.get_content_disposition() == "attachment"
    if plain is not None:
        assert message.get_filename() == f"{plain}-report.html"
        assert header.endswith(f"filename*=UTF-8''{quote(whole, safe='')}-report.html")


def test_a_report_is_downloaded_as_it_was_written(read):
    answer = read.get(f"/flights/{FAULT}/download")
    assert answer.text == "<html><body>\nas it was written</body></html>" and answer.status_code == 200
    assert answer.headers["content-disposition"].startswith('attachment; filename="a _b_ _i_-report.html"')
    assert "sandbox" in answer.headers["content-security-policy"]
    assert f'href="/flights/{FAULT}/download"' in read.get(f"/flights/{FAULT}").text
    assert "rotor 3" in read.get(f"/flights/{HEALTHY}/download").text, "made of what is stored"
    for bad in (NONE, "x", "..%2f"):
        assert read.get(f"/flights/{bad}/download").status_code == 404


# Deletion


def test_a_flight_is_deleted_once_and_for_all_tabs(made):
    client, flights, hub = made
    assert client.get("/api/about").json()["may_delete"] is True
    answer = client.delete(f"/api/flights/{FAULT}")
    assert answer.status_code == 200 and answer.json()["hash"] == FAULT
    assert not flights.page(FAULT).exists() and [p.name for p in flights.folder("").glob("*.*")] == []
    assert "event: deleted" in hub._recent[-1][1] and FAULT in hub._recent[-1][1]
    for path in (f"/api/flights/{FAULT}", f"/flights/{FAULT}", f"/flights/{FAULT}/download", f"/compare?a={FAULT}&b={HEALTHY}"):
        assert client.get(path).status_code == 404
    sent = len(hub._recent)
    again = client.delete(f"/api/flights/{FAULT}")
    assert again.status_code == 404 and again.json() == {"error": "No such flight."}
    for bad in (NONE, FAULT[:8], "%25", "..%2f..%2ffleet.db", "A" * 64):
        assert client.delete(f"/api/flights/{bad}").status_code == 404
    assert len(hub._recent) == sent and client.get("/api/flights").json()["total"] == 2


def test_nobody_deletes_unless_it_is_allowed(read, tmp_path):
    assert read.get("/api/about").json()["may_delete"] is False
    answer = read.delete(f"/api/flights/{FAULT}")
    assert answer.status_code == 403 and "--allow-delete" in answer.json()["error"]
    assert read.get(f"/api/flights/{FAULT}").status_code == 200
    for path in ("/", "/api/flights", f"/flights/{FAULT}", "/static/list.css"):
        assert read.delete(path).status_code == 405


def test_other_sites_and_strangers_delete_nothing(made, tmp_path):
    client, flights, _ = made
    for headers in ({"Origin": "http://evil.example"}, {"Origin": "null"}, {"Sec-Fetch-Site": "cross-site"}):
        assert client.delete(f"/api/flights/{FAULT}", headers=headers).status_code == 403
    assert client.post(f"/api/flights/{FAULT}?_method=DELETE").status_code == 405
    app = application(live.Feed(), flights, Limits(), "127.0.0.1", TOKEN, allow_delete=True)
    closed = TestClient(app, HERE)
    assert closed.delete(f"/api/flights/{FAULT}").status_code == 401
    assert closed.delete(f"/api/flights/{FAULT}?token=wrong-but-of-enough-letters").status_code == 401
    assert flights.row(FAULT)
    answer = closed.delete(f"/api/flights/{FAULT}", headers={"Authorization": f"Bearer {TOKEN}"})
    assert answer.status_code == 200 and flights.row(FAULT) is None


def test_a_store_that_cannot_be_written_keeps_flight_and_report(made, monkeypatch):
    client, flights, hub = made

    def refuse(*_, **__):
        raise StoreError("The store /srv/fleet.db cannot be written to.")

    sent = len(hub._recent)
    with monkeypatch.context() as patch:
        patch.setattr(type(flights._store._database), "writing", refuse)
        answer = client.delete(f"/api/flights/{FAULT}")
    assert answer.status_code == 503 and "/srv" not in answer.text and len(hub._recent) == sent
    assert flights.page(FAULT).read_text().endswith("as it was written</body></html>") and flights.row(FAULT)


def test_what_a_killed_deletion_left_is_finished_at_the_next_start(tmp_path):
    flights = Flights(str(tmp_path / "fleet.db"))
    fill(flights)
    flights.page(FAULT).rename(flights.page(FAULT).with_suffix(".deleted"))
    flights.page(NONE).with_suffix(".deleted").write_text("its rows were gone")
    flights.close()
    again = Flights(str(tmp_path / "fleet.db"))
    assert again.report(FAULT).endswith("as it was written</body></html>")
    assert sorted(p.name for p in again.folder("").glob("*.*")) == [f"{FAULT}.html"]


def test_a_flight_that_is_being_assessed_is_not_deleted_and_a_deleted_one_is_assessed_again(made, monkeypatch):
    client, flights, _ = made
    waiting = client.app._app.state.uploads
    first = send(client, "a.bin.xz", SAMPLE.read_bytes())
    digest = first.json()["hash"]
    assert first.status_code == 201 and flights.page(digest).exists()
    assert client.delete(f"/api/flights/{digest}").status_code == 200
    with monkeypatch.context() as patch:
        patch.setitem(waiting._logs, digest, None)
        answer = client.delete(f"/api/flights/{digest}")
        assert answer.status_code == 409 and "is being diagnosed" in answer.json()["error"]
    again = send(client, "b.bin.xz", SAMPLE.read_bytes())
    assert again.status_code == 201 and again.json()["name"] == "b.bin.xz"
    assert flights.page(digest).exists() and client.get(f"/flights/{digest}").status_code == 200


def test_deletions_and_lists_at_once(made):
    """Many tabs delete the same flights while others list them: each is deleted by one of them, and nobody gets an error of ours."""
    client, flights, _ = made
    hashes = [f"{k:064x}" for k in range(20)]
    for hash in hashes:
        flights.keep(Entry(hash, "", hash[-3:], 1, identity="uid 2", diagnosis={}))
        flights.page(hash).write_text("x")

    async def run():
        ask = [asyncio.to_thread(client.delete, f"/api/flights/{hash}") for hash in hashes for _ in range(3)]
        ask += [asyncio.to_thread(client.get, "/api/flights?sort=-loss") for _ in range(10)]
        return [answer.status_code for answer in await asyncio.gather(*ask)]

    codes = asyncio.run(run())
    assert codes.count(200) == 20 + 10 and codes.count(404) == 40
    assert sorted(p.name for p in flights.folder("").glob("*.*")) == [f"{FAULT}.html"] and flights.rows(1)["total"] == 3


def test_a_database_that_the_environment_names_is_served(server, tmp_path, monkeypatch):
    """Its reports lie where a store of this user would; each is deleted with its flight."""
    monkeypatch.setenv("ROTORWATCH_STORE", server.url())
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    flights = Flights()
    fill(flights)
    assert flights.page(FAULT) == tmp_path / "rotorwatch" / "fleet-pages" / f"{FAULT}.html" and flights.page(FAULT).exists()
    assert flights.delete(FAULT)["hash"] == FAULT and not flights.page(FAULT).exists()
    assert [f["hash"] for f in flights.rows(10, sort="-loss")["flights"]] == [HEALTHY, OLD]
    flights.close()


# The way in


def test_the_form_for_the_token_leads_to_what_was_asked_for(tmp_path):
    closed = TestClient(guarded(tmp_path, TOKEN)[0], HERE, follow_redirects=False)
    for path in (f"/flights/{NONE}", f"/compare?a={FAULT}&b={HEALTHY}", "/?sort=-loss&verdict=fault"):
        closed.cookies.clear()
        assert '<form method="post">' in closed.get(path).text, "sent to where it stands, so that a # stays"
        assert closed.post(path, data={"token": "wrong-but-of-enough-letters"}).status_code == 401
        evil = closed.post(path, data={"token": TOKEN}, headers={"Origin": "http://evil.example"})
        assert evil.status_code == 403
        answer = closed.post(path, data={"token": TOKEN})
        location = answer.headers["location"]
        assert answer.status_code == 303 and location.split("?")[0] == path.split("?")[0]
        assert sorted(location.split("?")[-1].split("&")) == sorted(path.split("?")[-1].split("&"))
        assert closed.post(path, data={"token": TOKEN}).status_code == 405, "who is let in has no form"
