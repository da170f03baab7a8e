"""`rotorwatch fleet` from the command line: logs in, aircraft distinguished, maintenance, pages and tables out."""

import json
import lzma
import shutil
from dataclasses import replace
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread

import numpy as np
import pytest

import rotorwatch
from conftest import hexa_diagnosis
from fleet_history import columns, wrench
from rotorwatch.fleet import Store, add
from rotorwatch.flight import Flight, Message, identity

pytest.importorskip("sqlalchemy")

SAMPLE = lzma.decompress((Path(rotorwatch.__file__).parent / "samples" / "quadx_healthy_hover.bin.xz").read_bytes())


@pytest.fixture
def quick(monkeypatch):
    """The diagnosis of a flight by itself is tested elsewhere: here it is a fabricated one."""
    import rotorwatch.diagnose as module

    said = {"verdict": "healthy"}
    monkeypatch.setattr(module, "diagnose", lambda flight, **more: replace(hexa_diagnosis(events=(), warnings=()), verdict=said["verdict"]))
    return said


@pytest.fixture
def folder(tmp_path):
    """Three logs of one aircraft that differ in their last byte, one in a folder below, and a file that is no log."""
    (tmp_path / "logs" / "below").mkdir(parents=True)
    for k, name in enumerate(("a.bin", "b.bin", "below/c.bin")):
        (tmp_path / "logs" / name).write_bytes(SAMPLE + bytes([k]))
    (tmp_path / "logs" / "notes.txt").write_text("no log")
    return tmp_path / "logs"


@pytest.fixture
def call(run, tmp_path):
    def call(*words):
        return run("fleet", *words, "--store", tmp_path / "fleet.db")

    return call


def test_a_folder_is_added_once(call, folder, quick, tmp_path):
    code, out, err = call("add", folder)
    assert code == 0 and out.count("healthy") == 3
    assert "3 added, 1 files that are not logs; 3 flights in" in err
    shutil.copy(folder / "a.bin", folder / "copy of a.bin")
    code, out, err = call("add", folder, folder / "a.bin")
    assert code == 0 and not out and "0 added, 4 known already" in err
    with Store(tmp_path / "fleet.db") as store:
        (one,) = store.aircraft()
        assert one["flights"] == 3 and not one["stale"]
        trim = store.flight(store.flights()[0]["hash"])["trim"]
        assert np.shape(trim["effectiveness"]) == (4, 4) and trim["blocks"] > 5


def test_a_store_among_its_logs_is_no_log(folder, quick, run):
    """`fleet simulate --logs` writes both into one folder; SQLite files that are no bags are passed over."""
    for wanted in ("3 added", "0 added"):
        code, _, err = run("fleet", "add", folder, "--store", folder / "fleet.db")
        assert code == 0 and wanted in err and "bag" not in err


def test_a_log_behind_an_address_is_fetched_once(folder, quick, call):
    """A new one by who assesses it; a known one to see whether it has changed. A copy at another address is known, too."""
    asked = []

    class Served(SimpleHTTPRequestHandler):
        def do_GET(self):
            asked.append(self.path)
            super().do_GET()

        def log_message(self, *_):
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), partial(Served, directory=folder)) as server:
        Thread(target=server.serve_forever, daemon=True).start()
        where = f"http://127.0.0.1:{server.server_port}"
        code, _, err = call("add", f"{where}/a.bin", "--jobs", "1")
        assert code == 0 and "1 added" in err and asked == ["/a.bin"]
        assert "0 added, 1 known already" in call("add", f"{where}/a.bin", "--jobs", "1")[2]
        assert asked == ["/a.bin"] * 2
        shutil.copy(folder / "a.bin", folder / "copy.bin")
        assert "0 added, 1 known already" in call("add", f"{where}/copy.bin", "--jobs", "1")[2]
        server.shutdown()


def test_what_cannot_be_assessed_is_said_and_the_rest_added(call, folder, quick):
    (folder / "broken.bin").write_bytes(SAMPLE[:200])
    code, out, err = call("add", folder / "broken.bin", folder / "a.bin")
    assert code == 2 and out.count("healthy") == 1 and "broken.bin" in err and "1 added, 1 could not be diagnosed" in err
    code, _, err = call("add", folder / "nothing*.bin")
    assert code == 2 and "fits no flight log" in err


def test_a_bad_file_of_a_folder_is_remembered(call, folder, quick):
    """A folder with one bad file is not an error for ever: it is named, and tried again once it has changed."""
    (folder / "broken.bin").write_bytes(SAMPLE[:200])
    assert call("add", folder)[0] == 2
    code, _, err = call("add", folder)
    assert code == 0 and "failed" not in err and "1 could not be diagnosed before" in err and "broken.bin" in err
    code, _, err = call("add", folder / "broken.bin")
    assert code == 2 and "1 could not be diagnosed" in err, "one that is named by itself is tried again"
    (folder / "broken.bin").write_bytes(SAMPLE[:300])
    assert call("add", folder)[0] == 2
    (folder / "broken.bin").write_bytes(SAMPLE + b"whole")
    code, _, err = call("add", folder)
    assert code == 0 and "1 added" in err and "before" not in err


def test_an_aircraft_that_crashes_stands_first(call, folder, quick):
    """What its flights were assessed counts, and not only the trend of its rotors; what is not assessed is not green."""
    call("add", folder / "a.bin", "--aircraft", "calm")
    quick["verdict"] = "inconclusive"
    call("add", folder / "below" / "c.bin", "--aircraft", "doubtful")
    quick["verdict"] = "crashed"
    call("add", folder / "b.bin", "--aircraft", "wreck")
    rows = json.loads(call("list", "--json")[1])["aircraft"]
    assert [(a["name"], a["state"]) for a in rows] == [("wreck", "fault"), ("doubtful", "not assessed"), ("calm", "healthy")]
    assert rows[0]["standing"]["last"]["verdict"] == "crashed" and "crashed" in rows[0]["standing"]["headline"]
    assert not any(a["new"] for a in rows), "nothing is new before the first look"
    assert " 1 crashed" not in call("list")[1].replace("Of 1 flight 1 crashed", "")
    (folder / "d.bin").write_bytes(SAMPLE + b"d")
    call("add", folder / "d.bin", "--aircraft", "calm")
    rows = json.loads(call("list", "--json")[1])["aircraft"]
    assert {a["name"]: (a["state"], a["new"]) for a in rows[:2]} == {"calm": ("fault", {"crashed": 1}), "wreck": ("fault", {})}
    _, out, _ = call("list")
    assert "1 crashed" in out and "fault" in out
    assert not any(a["new"] for a in json.loads(call("list", "--json")[1])["aircraft"])


def test_processes_make_the_same_store(folder, tmp_path):
    (folder / "broken.bin").write_bytes(SAMPLE[:200])
    shutil.copy(folder / "a.bin", folder / "copy of a.bin")
    kept, fates = [], []
    for jobs in (1, 2):
        with Store(tmp_path / f"{jobs}.db") as store:
            reported, others = add.add(store, [folder], jobs=jobs)
            fates.append(sorted((str(t.path), t.state, t.aircraft) for t in reported))
            kept.append([store.flight(row["hash"]) for row in store.flights("date")])
            assert others == 1
    assert [state for _, state, _ in fates[0]] == ["added", "added", "added", "failed", "known"]
    assert fates[0] == fates[1] and kept[0] == kept[1] and len(kept[0]) == 3


def test_aircraft_are_listed_shown_renamed_and_serviced(call, folder, quick):
    call("add", folder, "--aircraft", "quad 7")
    code, out, _ = call("list")
    assert code == 0 and "quad 7" in out and "No rotor has lost" in " ".join(out.split())
    code, out, _ = call("list", "--flights", "--json")
    rows = json.loads(out)
    assert code == 0 and rows["total"] == 3 and {r["aircraft_name"] for r in rows["flights"]} == {"quad 7"}
    code, out, _ = call("service", "quad 7", "new propeller", "--rotor", "3", "--after", rows["flights"][1]["hash"][:10])
    assert code == 0 and out.startswith("quad 7: rotor 3, new propeller")
    code, _, err = call("service", "quad 7", "new propeller", "--at", "last week")
    assert code == 2 and "2026-05-01" in err
    code, out, _ = call("show", "QUAD 7")
    assert code == 0 and "service before flight 3: rotor 3, new propeller" in out and "3 of 3 flights were used" in out
    assert call("rename", "quad 7", "quad 8")[0] == 0
    code, out, _ = call("show", "name quad 7", "--json")
    assert code == 0 and json.loads(out)["name"] == "quad 8" and len(json.loads(out)["points"]["loss"]) == 3
    code, _, err = call("show", "quad 9")
    assert code == 2 and "did you mean quad 8" in err


def test_two_are_made_one(call, folder, quick):
    call("add", folder / "a.bin", "--aircraft", "one")
    call("add", folder / "b.bin", "--aircraft", "two")
    assert call("merge", "one", "two")[0] == 0
    call("add", folder / "below" / "c.bin", "--aircraft", "two")
    code, out, _ = call("list", "--json")
    (only,) = json.loads(out)["aircraft"]
    assert code == 0 and only["flights"] == 3 and only["identities"] == ["name one", "name two"]


def test_assessing_again_says_what_changed(call, folder, quick, tmp_path):
    call("add", folder)
    assert "0 diagnosed again" in call("reassess")[1]
    quick["verdict"] = "ambiguous"
    (folder / "b.bin").unlink()
    (folder / "below" / "c.bin").write_bytes(SAMPLE + b"other")
    code, out, _ = call("reassess", "--all")
    assert code == 0 and "a.bin  healthy -> ambiguous" in out and "1 diagnosed again, 1 changed" in out
    assert "kept as it was" in out and "has changed" in out
    with Store(tmp_path / "fleet.db") as store:
        assert sorted(r["verdict"] for r in store.flights()) == ["ambiguous", "healthy", "healthy"]


def test_pages_and_tables(call, folder, quick, tmp_path):
    call("add", folder, "--aircraft", "<b>quad</b>")
    code, out, _ = call("report", "-o", tmp_path / "pages")
    assert code == 0 and "2 pages" in out
    index = (tmp_path / "pages" / "index.html").read_text()
    assert "&lt;b&gt;quad" in index and "<b>quad" not in index
    (page,) = (tmp_path / "pages").glob("aircraft-*.html")
    text = page.read_text()
    assert text.count("<svg") == 4 and page.name in index and "http" not in text
    parquet = pytest.importorskip("pyarrow.parquet")
    code, out, _ = call("export", "-o", tmp_path / "tables")
    assert code == 0 and len(out.split()) == 4
    rows = {name: parquet.read_table(tmp_path / "tables" / f"{name}.parquet") for name in ("flights", "aircraft", "rotors", "services")}
    assert [rows[k].num_rows for k in rows] == [3, 1, 4, 0]
    assert rows["rotors"]["status"].to_pylist() == ["healthy"] * 4


def test_a_store_that_is_not_there_is_said(call):
    for words in (("list",), ("show", "x"), ("report", "-o", "pages")):
        code, _, err = call(*words)
        assert code == 2 and "fleet add" in err


def test_logs_are_added_as_they_come(folder, quick, tmp_path):
    reported, looks = [], iter(range(6))

    def stop():
        look = next(looks)
        if look == 2:
            (folder / "new.bin").write_bytes(SAMPLE + b"new")
        return look == 5

    with Store(tmp_path / "fleet.db") as store:
        add.follow(store, [folder], tell=reported.append, poll_s=0.0, stop=stop)
        assert [Path(t.path).name for t in reported if t.state == "added"] == ["a.bin", "b.bin", "c.bin", "new.bin"]
        assert store.count() == 4 and not store.aircraft()[0]["stale"]


def a_flight(texts=(), parameters=None, **facts):
    said = tuple(Message(0.0, "text", text) for text in texts)
    return Flight("log", "ArduPilot", {}, 1.0, messages=said, parameters=parameters or {}, facts=facts)


def test_whose_flight_it_is():
    board = identity.identify(a_flight(["ArduCopter V4.5.7", "CubeOrange 003A0026 3131510D 34393334"]))
    assert board == ("serial CubeOrange 003A00263131510D34393334", "CubeOrange-3334", "serial number")
    px4 = identity.identify(a_flight(sys_uuid="000200000000373833333430510a002c001f", ver_hw="PX4_FMU_V5"))
    assert px4.called == "PX4_FMU_V5-001f" and px4.by == "serial number"
    measured = {"INS_ACCOFFS_X": 0.0312345, "INS_ACCOFFS_Y": -0.0123456, "INS_ACCOFFS_Z": 0.4565432}
    one, same = (identity.identify(a_flight(parameters=measured)) for _ in range(2))
    other = identity.identify(a_flight(parameters=measured | {"INS_ACCOFFS_Z": 0.4565433}))
    assert one == same != other and one.by == "calibration"
    assert identity.identify(a_flight(parameters=dict.fromkeys(measured, 0.001))).text == ""  # as delivered
    assert identity.identify(a_flight()).text == ""
    machine = "3d1219c7c4c5404aaa1f6d2a48adfda4"
    two = {identity.identify(a_flight([machine], {"MAV_SYSID": k})).text for k in (1.0, 2.0)}
    assert len(two) == 2  # simulators on one machine
    assert identity.count(a_flight(parameters={"STAT_BOOTCNT": 12.0})) == 12 and identity.count(a_flight()) is None


def test_a_fleet_is_flown_and_scored(monkeypatch, tmp_path, run):
    """The stories and their score; the flights are made of numbers here, not flown."""
    from rotorwatch.fleet.store import Entry
    from rotorwatch_lab import synthetic_fleet as synthetic

    def fly(story, number, flights, seed):
        rng = np.random.default_rng([seed, number])
        n = 4 if story.frame.startswith("quad") else 6
        for k in range(flights):
            theta = np.zeros((1, n))
            if story.rotor >= 0:
                theta[0, story.rotor] = story.loss(k, flights)
            w = wrench(columns(n), theta)[0] + 0.006 * rng.standard_normal(3)
            yield story, k, n, w + ([0.02, 0.02, 0.0] if story.kind == "battery moved" and k >= story.start else 0.0)

    def of_flight(flown, hash, path, size):
        from fleet_history import row

        story, k, n, w = flown
        table = row(k, w, n)
        known = {key: table[key] for key in ("utc", "airborne_s", "rotors", "verdict", "trim")}
        return Entry(hash=hash, path=path, name=path, size=size, identity=f"serial {story.name}", build=story.frame, **known)

    monkeypatch.setattr(synthetic, "fly", fly)
    monkeypatch.setattr(synthetic.flight_result, "of_flight", of_flight)
    code, out, _ = run("fleet", "simulate", "-o", tmp_path / "sim", "--aircraft", 10, "--flights", 30, "--json")
    found = json.loads(out)
    assert code == 0 and found["flights"] == 300 and found["weak"] >= 2
    assert found["auc"] > 0.95 and found["right"] == 1.0 and found["false"] == 0.0
    again = run("fleet", "simulate", "-o", tmp_path / "sim", "--aircraft", 10, "--flights", 30, "--json")
    assert again[:2] == (0, out)


# Flights: filters, comparison, deletion


@pytest.fixture
def three(call, folder, quick):
    """A store of three flights, one of which is ambiguous and of another aircraft; the start of their hashes by name."""
    call("add", folder / "a.bin", folder / "b.bin", "--aircraft", "quad 7")
    quick["verdict"] = "ambiguous"
    call("add", folder / "below" / "c.bin", "--aircraft", "quad 8")
    rows = json.loads(call("list", "--flights", "--json")[1])["flights"]
    return {row["name"]: row["hash"][:10] for row in rows}


def test_flights_are_filtered_and_sorted_as_in_the_page(call, three):
    def names(*words):
        code, out, err = call("list", "--json", *words)
        assert code == 0, err
        found = json.loads(out)
        return found["total"], [row["name"] for row in found["flights"]]

    assert names("--verdict", "ambiguous,fault") == (1, ["c.bin"])
    assert names("--aircraft", "quad 7", "--sort", "name") == (2, ["a.bin", "b.bin"])
    assert names("--sort", "-verdict", "--limit", 1) == (3, ["c.bin"])
    assert names("--sort", "name", "--limit", 1, "--offset", 1) == (3, ["b.bin"])
    assert names("--min-loss", 0.5) == (0, []) and names("--min-duration", 1)[0] == 3
    assert names("--since", "2000-01-01")[0] == 3 and names("--until", "2000-01-01")[0] == 0
    _, out, _ = call("list", "--verdict", "ambiguous")
    assert "1 of 1 flights" in out and "c.bin" in out and "duration" in out
    for words, says in (
        (("--sort", "size"), "sort size: choose from date"),
        (("--verdict", "bad"), "choose from healthy"),
        (("--since", "May"), "give a day"),
        (("--min-loss", 10), "0.1 for 10 %"),
        (("--aircraft", "quad 9"), "did you mean"),
    ):
        code, out, err = call("list", *words)
        assert code == 2 and not out and says in err and len(err.strip().splitlines()) == 1


def test_filters_have_the_same_names_everywhere():
    from dataclasses import fields

    from rotorwatch.commands.fleet_flights import list_
    from rotorwatch.fleet.listing import NEWEST, ORDERS, Filters

    page = Path(rotorwatch.__file__).parent / "serve" / "page"
    names = [field.name for field in fields(Filters)]
    options = {option.name: option for option in list_.params}
    assert set(names) < set(options) and options["sort"].default == NEWEST
    assert all(order in options["sort"].help for order in ORDERS)
    said = (page / "address.js").read_text("utf-8").split("NAMES = ")[1].split(";")[0]
    assert json.loads(said) == [*names, "sort"]
    form = (page / "index.html").read_text("utf-8").split('id="sort"')[1].split("</select>")[0]
    assert {text.split('"')[0] for text in form.split('value="')[1:]} == {way + name for name in ORDERS for way in ("", "-")}


def test_two_flights_are_compared(call, three):
    code, out, _ = call("compare", three["a.bin"], three["c.bin"], "--json")
    found = json.loads(out)
    assert code == 0 and found["headline"] == "They differ in verdict and aircraft."
    assert [flight["name"] for flight in found["flights"]] == ["a.bin", "c.bin"] and len(found["rotors"]) == 6
    code, out, _ = call("compare", three["a.bin"], three["c.bin"])
    assert code == 0 and out.startswith(found["headline"]) and "! aircraft" in out and "quad 8" in out
    code, out, _ = call("compare", three["a.bin"], three["b.bin"])
    assert code == 0 and out.startswith("The answers agree within their intervals.") and "!" not in out
    for words, says in ((("a.bin", three["a.bin"]), "no flight with such a hash"), ((three["a.bin"],) * 2, "two different")):
        code, out, err = call("compare", *words)
        assert code == 2 and not out and says in err


def test_flights_are_deleted_and_added_again(call, three, folder, tmp_path):
    report = tmp_path / "fleet-pages" / "none.html"
    with Store(tmp_path / "fleet.db") as store:
        hash = store.flight(three["c.bin"])["hash"]
        report = store.reports.path(hash)
        report.parent.mkdir()
        report.write_text("a report")
    code, out, err = call("delete", three["c.bin"])
    assert code == 2 and "--yes" in err and not out, "without confirmation"
    code, out, err = call("delete", three["c.bin"], "0123456789", "--yes")
    assert code == 2 and "0123456789: the store holds no flight" in err and report.exists(), "all or none"
    code, out, err = call("delete", three["c.bin"], three["c.bin"], "--yes")
    assert code == 0 and out == f"deleted {hash[:8]}  c.bin\n" and not report.exists() and not list(report.parent.iterdir())
    (only,) = json.loads(call("list", "--json")[1])["aircraft"]
    assert only["name"] == "quad 7" and not only["stale"], "standings are worked out anew"
    assert call("delete", three["c.bin"], "--yes")[0] == 2
    assert (folder / "below" / "c.bin").exists(), "logs are not touched"
    code, _, err = call("add", folder)
    assert code == 0 and "1 added, 2 known already" in err


def test_deletion_asks_first(three, monkeypatch, tmp_path):
    from click.testing import CliRunner

    from rotorwatch.commands import fleet_flights

    class Terminal:
        def isatty(self):
            return True

    monkeypatch.setattr(fleet_flights, "sys", type("Sys", (), {"stdin": Terminal()}))
    words = ["delete", three["a.bin"], "--store", str(tmp_path / "fleet.db")]
    no = CliRunner().invoke(fleet_flights.fleet, words, input="n\n")
    assert no.exit_code == 1 and "Delete this flight permanently?" in no.output and "a.bin" in no.output
    with Store(tmp_path / "fleet.db") as store:
        assert store.count() == 3
    assert CliRunner().invoke(fleet_flights.fleet, words, input="y\n").exit_code == 0
    with Store(tmp_path / "fleet.db") as store:
        assert store.count() == 2


def test_a_flight_that_is_deleted_while_all_are_assessed_again(three, monkeypatch, tmp_path):
    assess_again = Store.assess_again

    def deleted_first(store, entry):
        if entry.name == "b.bin":
            store.delete(entry.hash)
        assess_again(store, entry)

    monkeypatch.setattr(Store, "assess_again", deleted_first)
    with Store(tmp_path / "fleet.db") as store:
        count, _ = add.reassess(store, every=True, jobs=1)
        assert count == 2 and store.count() == 2


# Alerts


def test_a_faulty_flight_that_comes_is_alerted_and_its_aircraft_once(folder, quick, tmp_path):
    alerts, looks = [], iter(range(9))

    def stop():
        look = next(looks)
        if look in (2, 5):  # two faulty flights of an aircraft that was healthy
            quick["verdict"] = "fault"
            (folder / f"new-{look}.bin").write_bytes(SAMPLE + b"new" * look)
        return look == 8

    with Store(tmp_path / "fleet.db") as store:
        add.follow(store, [folder], poll_s=0.0, stop=stop, alert=alerts.append)
        name = store.aircraft()[0]["name"]
    assert [(a["type"], a.get("log", a.get("state"))) for a in alerts] == [
        ("flight", "new-2.bin"), ("aircraft", "fault"), ("flight", "new-5.bin")
    ]  # fmt: skip
    assert {a["aircraft"] for a in alerts} == {name} and alerts[1]["was"] == "healthy" and alerts[1]["headline"]
    assert alerts[0]["verdict"] == "fault" and alerts[0]["headline"]


def test_the_command_posts_alerts(call, folder, quick, tmp_path, monkeypatch):
    posted = []

    class Posts(SimpleHTTPRequestHandler):
        def do_POST(self):
            posted.append(json.loads(self.rfile.read(int(self.headers["Content-Length"]))))
            self.send_response(200)
            self.end_headers()

        def log_message(self, *args):
            pass

    def follow(store, folders, *args, alert, **more):
        alert({"type": "aircraft", "aircraft": "quad 7", "state": "fault", "was": "healthy", "headline": "Rotor 3 is worn."})

    monkeypatch.setattr(add, "follow", follow)
    with ThreadingHTTPServer(("127.0.0.1", 0), Posts) as server:
        Thread(target=server.serve_forever, daemon=True).start()
        code, _, err = call("add", folder, "--follow", "--webhook", f"http://127.0.0.1:{server.server_port}/in")
        server.shutdown()
    assert code == 0 and [p["aircraft"] for p in posted] == ["quad 7"]
    assert "quad 7 is fault now, it was healthy: Rotor 3 is worn." in err
    assert "begins with http" in call("add", folder, "--follow", "--webhook", "nowhere")[2]


def test_flights_since_yesterday(call, folder, quick):
    call("add", folder)
    code, out, _ = call("list", "--since", "yesterday")
    assert code == 0 and "0 of 0 flights" in out
    assert "or yesterday" in call("list", "--since", "last week")[2]


def test_red_aircraft_come_first_in_colour_on_the_page(call, folder, quick, tmp_path):
    call("add", folder / "a.bin", "--aircraft", "a fine one")
    quick["verdict"] = "fault"
    call("add", folder / "b.bin", "--aircraft", "the bad one")
    call("list")
    call("add", folder / "below" / "c.bin", "--aircraft", "the bad one")
    call("report", "-o", tmp_path / "pages")
    index = (tmp_path / "pages" / "index.html").read_text()
    assert 'class="of-fault"' in index
    assert index.index("the bad one") < index.index("a fine one") and "1 fault" in index and "width=device-width" in index
