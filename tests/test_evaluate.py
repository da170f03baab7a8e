"""`rotorwatch evaluate`: lists of labelled flights, their scores, and what is written."""

import csv
import json
from dataclasses import replace
from pathlib import Path

import pytest

import rotorwatch as rw
from conftest import hexa_diagnosis, hexa_event
from rotorwatch.commands import cli
from rotorwatch.errors import ConfigError
from rotorwatch_lab.experiments import counting, evaluate, labels
from rotorwatch_lab.experiments.labels import Fault, Labelled

HEXA, QUAD = "hexax_m3_mul0.80_square_wind.bin.xz", "quadx_healthy_hover.bin.xz"


def listed(tmp_path, *lines, head="path,rotor,onset_s,size,end_s,vehicle,baseline,label_source"):
    path = tmp_path / "labels.csv"
    path.write_text("\n".join([head, *lines]) + "\n")
    return path


# ---------------------------------------------------------------- lists


def test_a_list_with_everything(tmp_path):
    path = listed(tmp_path, "a.bin,1+4,12.5,0.2,30,v.toml,b.bin; c.bin,bench", "", "b.bin,,,,,,,", "a.bin,2,40,,,v.toml,b.bin;c.bin,")
    first, second = labels.read(path)
    assert first.faults == (Fault((1, 4), 12.5, 0.2, 30.0), Fault((2,), 40.0))
    assert (first.name, first.path, first.vehicle) == ("a.bin", str(tmp_path / "a.bin"), str(tmp_path / "v.toml"))
    assert first.baseline == (str(tmp_path / "b.bin"), str(tmp_path / "c.bin")) and first.label_source == "bench"
    assert second == Labelled("b.bin", str(tmp_path / "b.bin"))


@pytest.mark.parametrize("between", [";", "\t"])
def test_a_list_of_a_spreadsheet_whose_numbers_have_a_comma(tmp_path, between):
    cells = (["path", "rotor", "onset_s", "size"], ["a.bin", "1+4", "12,5", "0,2"], ["b.bin", "", "", ""])
    path = tmp_path / "labels.csv"
    path.write_text("".join(between.join(row) + "\n" for row in cells), encoding="utf-8-sig")
    assert [flight.faults for flight in labels.read(path)] == [(Fault((1, 4), 12.5, 0.2),), ()]


@pytest.mark.parametrize(
    ("lines", "says"),
    [
        (["a.bin,x,1"], r"line 2: rotor 'x': give numbers from 1"),
        (["a.bin,0,1"], r"rotor '0'"),
        (["a.bin,1,"], r"line 2 has no onset_s; give 0 where"),
        (["a.bin,1,soon"], r"onset_s 'soon': give a number, 0 or more"),
        (["a.bin,1,-3"], r"onset_s '-3'"),
        (["a.bin,1,1,1.5"], r"size 1.5: give the lost share"),
        (["a.bin,1,9,,8"], r"end_s 8 is not after onset_s 9"),
        (["a.bin,,,0.3"], r"value for size but no rotor"),
        ([",1,3"], r"line 2 has no path"),
        (["a.bin,1,3", "a.bin,,"], r"line 3 names .*a.bin again"),
        (["a.bin,1,3", "a.bin,2,9,,,v.toml"], r"another vehicle or baseline"),
        (["a.bin,1,3,,,,,,,more"], r"more cells than the first line"),
        ([], r"lists no flight"),
    ],
)
def test_bad_rows_get_one_sentence(tmp_path, run, lines, says):
    with pytest.raises(ConfigError, match=says):
        labels.read(listed(tmp_path, *lines))
    code, _, err = run("evaluate", listed(tmp_path, *lines))
    assert code == 2 and "Traceback" not in err and len(err.strip().splitlines()) == 1


@pytest.mark.parametrize("content", [b"", b"\xff\xfe\x00", b"time,motor\n1,2\n", b"rotor,path of it\n1,a.bin\n"])
def test_files_that_are_no_list(tmp_path, content):
    path = tmp_path / "labels.csv"
    path.write_bytes(content)
    with pytest.raises(ConfigError, match="list"):
        labels.read(path)
    with pytest.raises(ConfigError, match="no such file"):
        labels.read(tmp_path / "none.csv")


# ---------------------------------------------------------------- scores


def answer(*events, verdict="fault", hops=((10.0, 60.0),), **changes):
    made = hexa_diagnosis(events=events, verdict=verdict, **changes)
    return replace(made, flight={**made.flight, "hops": [list(h) for h in hops]})


def event(rotors=(3,), onset=31.2, detected=31.6, alternatives=(), loss=0.3):
    n = len(rotors)
    return hexa_event(
        rotors=rotors, onset_s=onset, detected_s=detected, alternatives=alternatives, loss=(loss,) * n, interval=((0.2, 0.4),) * n
    )


def scored(answer, *faults):
    return evaluate.scored(Labelled("a.bin", "a.bin", faults), answer)


def test_a_fault_that_is_found():
    (row,) = scored(answer(event()), Fault((3,), 31.0, 0.35))
    assert (row["outcome"], row["found"], row["holds"], row["false_alarms"]) == ("right", True, True, 0)
    assert row["delay_s"] == pytest.approx(0.6) and row["onset_error_s"] == pytest.approx(0.2)
    assert row["size_error"] == pytest.approx(-0.05) and row["healthy_s"] == pytest.approx(21.0)


def test_an_alarm_before_the_onset_is_false_and_healthy_time_ends_there():
    (row,) = scored(answer(event((1,), 15.0, 16.0), event()), Fault((3,), 31.0))
    assert (row["outcome"], row["false_alarms"], row["size_error"]) == ("extra", 1, None)
    (row,) = scored(answer(event(detected=40.0, onset=39.0)), Fault((3,), 30.0, end_s=38.0))
    assert row["false_alarms"] == 1 and row["healthy_s"] == pytest.approx(42.0)  # it begins after the rotor was whole again


def test_faults_one_after_the_other_are_assessed_by_their_own_events():
    first, second = scored(answer(event(), event((5,), 45.0, 46.0)), Fault((3,), 31.0, end_s=40.0), Fault((5,), 45.0))
    assert (first["outcome"], second["outcome"]) == ("right", "right")
    assert (first["healthy_s"], second["healthy_s"]) == (pytest.approx(26.0), 0.0)
    first, second = scored(answer(event((3,), 31.0, 31.5)), Fault((3,), 31.0, end_s=40.0), Fault((5,), 45.0))
    assert (first["outcome"], second["outcome"]) == ("right", "missed")


def test_a_second_fault_while_the_first_one_lasts():
    faults = Fault((3,), 31.0, end_s=50.0), Fault((5,), 45.0)
    pair = event((3, 5), 45.1, 45.6)
    first, second = scored(answer(event(), pair), *faults)
    assert (first["outcome"], second["outcome"]) == ("right", "right") and second["loss"] == pytest.approx(0.3)
    assert first["healthy_s"] == pytest.approx(21.0)  # broken from 31 s to the end
    _, second = scored(answer(event(), event((3,), 45.1, 45.6)), *faults)
    assert second["outcome"] == "missed"  # the rotor that was broken before is no wrong one


def test_from_take_off_delays_count_from_it_and_before_it_nothing_is_healthy():
    (row,) = scored(answer(event((3,), 12.0, 13.0)), Fault((3,), 0.0))
    assert row["delay_s"] == pytest.approx(3.0) and row["onset_error_s"] is None and row["healthy_s"] == 0.0


def test_candidates_are_found_but_not_right():
    (row,) = scored(answer(event((1,), alternatives=((3,),)), verdict="ambiguous"), Fault((3,), 31.0))
    assert (row["outcome"], row["found"], row["candidates"]) == ("among", True, "1+3")


def test_a_healthy_flight_that_is_accused_by_a_comparison_alone_has_a_false_alarm():
    made = answer()
    weak = replace(made, rotors=tuple(replace(r, status="degraded" if r.rotor == 2 else "healthy") for r in made.rotors))
    (row,) = scored(weak)
    assert (row["outcome"], row["accused"], row["false_alarms"]) == ("accused", "2", 1)
    (row,) = scored(replace(answer(verdict="healthy"), rotors=()))
    assert (row["outcome"], row["false_alarms"], row["healthy_s"]) == ("clean", 0, pytest.approx(50.0))


def test_the_summary_counts_faults_and_hours():
    rows = [
        *scored(answer(event()), Fault((3,), 31.0, 0.35)),
        *scored(answer(event((1,), 33.0, 34.0)), Fault((3,), 31.0, 0.35)),
        *scored(answer(verdict="healthy", hops=((0.0, 3600.0),))),
        *evaluate._refused(Labelled("x.bin", "x.bin"), "no."),
    ]
    s = evaluate.summarise(rows)
    assert (s["faults"], s["healthy"], s["refused"]) == (2, 1, 1)
    assert (s["right"]["value"], s["wrong"]["value"], s["found"]["value"]) == (0.5, 0.5, 0.5)
    assert s["size_rms"]["value"] == pytest.approx(0.05) and s["holds"]["value"] == 1.0
    assert s["false_alarms_h"]["n"] == 0 and s["false_alarms_h"]["high"] == pytest.approx(3.689 / s["healthy_h"], rel=1e-3)


def test_an_outcome_has_one_definition():
    assert counting.outcome(answer(event(), event((1,))), (3,), 31.0) == "extra"
    assert counting.outcome(answer(event((3, 5))), (3, 5), 31.0) == "right"
    assert counting.outcome(answer(event((3,))), (3, 5), 31.0) == "partly"


# ---------------------------------------------------------------- the command


def test_the_example_of_the_document(tmp_path, run, monkeypatch):
    """docs/evaluate.md, executed on the sample flights."""
    page = (Path(__file__).parent.parent / "docs" / "evaluate.md").read_text()
    _, text, printed = (part.split("```")[0] for part in page.split("```text")[0:3])
    path = tmp_path / "labels.csv"
    path.write_text(text.strip() + "\n")
    for name in (HEXA, QUAD):
        (tmp_path / name).write_bytes((cli.SAMPLES / name).read_bytes())
    monkeypatch.chdir(tmp_path)
    page_, rows_, all_ = tmp_path / "p.html", tmp_path / "r.csv", tmp_path / "a.json"
    code, out, _ = run("evaluate", path, "-o", page_, "-o", rows_, "-o", all_, "--jobs", 1)
    assert code == 0 and printed.strip() in out
    rows = list(csv.DictReader(rows_.open()))
    assert [(r["path"], r["outcome"]) for r in rows] == [(HEXA, "right"), (QUAD, "clean")]
    assert json.loads(all_.read_text())["summary"]["right"]["value"] == 1.0
    assert HEXA in page_.read_text() and "<h1" not in page_.read_text()[:50]
    result = rw.evaluate([{"path": HEXA, "rotor": 3, "onset_s": 47.6, "size": 0.37}, {"path": "none.bin"}], jobs=1)
    assert result["flights"][0]["outcome"] == "right"
    assert result["flights"][1]["outcome"] == "refused" and result["flights"][1]["sentence"] == "none.bin: no such file."


def test_refused_logs_are_said_and_counted(tmp_path, run):
    (tmp_path / "broken.bin").write_bytes(b"nothing at all")
    (tmp_path / QUAD).write_bytes((cli.SAMPLES / QUAD).read_bytes())
    code, out, err = run("evaluate", listed(tmp_path, "broken.bin,2,3", f"{QUAD},9,3"), "--jobs", 1)
    assert code == 0 and "2, 2 refused" in out
    assert err.count("refused: ") == 2 and "names rotor 9 of a vehicle with 4" in err


def test_a_target_of_another_kind_is_refused_before_the_work(tmp_path, run):
    code, _, err = run("evaluate", listed(tmp_path, "a.bin,,"), "-o", tmp_path / "x.pdf")
    assert code == 2 and "ends in .html, .csv or .json" in err


# ---------------------------------------------------------------- another detector

MINE = """
name = "late"

def detect(flight, vehicle, airborne):
    assert airborne[0][0] < 10.0 and vehicle.rotors
    if len(vehicle.rotors) == 6:
        yield {"rotor": 3, "time_s": 50.0}
"""


@pytest.fixture
def flights(tmp_path):
    """A folder of the two sample flights, and a detector that finds rotor 3 of the hexarotor at 50 s."""
    folder = tmp_path / "logs"
    folder.mkdir()
    for name in (HEXA, QUAD):
        (folder / name).symlink_to(cli.SAMPLES / name)
    (tmp_path / "mine.py").write_text(MINE)
    return folder


def test_a_detector_is_scored_beside_rotorwatch(flights, tmp_path, run):
    listed(flights, f"{HEXA},3,47.6,0.37", QUAD, head="path,rotor,onset_s,size")
    code, out, err = run("evaluate", flights, "--detector", tmp_path / "mine.py", "-o", tmp_path / "both.csv", "-q", "--jobs", 1)
    assert code == 0, err
    rows = {(row["path"], row["detector"]): row for row in csv.DictReader((tmp_path / "both.csv").open())}
    assert len(rows) == 4 and {row["outcome"] for key, row in rows.items() if key[0] == QUAD} == {"clean"}
    own, late = rows[HEXA, "rotorwatch"], rows[HEXA, "late"]
    assert own["outcome"] == late["outcome"] == "right" and float(late["delay_s"]) == pytest.approx(2.4, abs=0.01)
    assert float(own["delay_s"]) < 0.5 and float(own["alarm_s"]) < 48.1 and float(late["alarm_s"]) == 50.0 and late["loss"] == ""
    said = " ".join(out.split())
    assert "both on 1 of 2 flights, rotorwatch 2.28 s earlier (median)" in said and "late 100 % (21 to 100)" in said


def test_a_folder_without_labels_is_compared_and_not_counted(flights, tmp_path):
    result = evaluate.evaluate(flights, jobs=1, detector=str(tmp_path / "mine.py"))
    assert {row["outcome"] for row in result["flights"]} == {"unknown"} and len(result["flights"]) == 4
    assert result["summary"]["faults"] == result["summary"]["healthy"] == 0 and result["summary"]["false_alarms_h"] is None
    assert dict(evaluate.first(result["flights"]))["alarms"].startswith("both on 1 of 2 flights")
    (tmp_path / "empty").mkdir()
    with pytest.raises(ConfigError, match=r"neither labels.csv nor a flight log"):
        labels.read(tmp_path / "empty")


@pytest.mark.parametrize(("text", "says"), [
    ("name = 'x'", "defines no detect"), ("1 / 0", "cannot be loaded: ZeroDivisionError"),
    ("name = 'x'\ndef detect(*a): return [{'rotor': 9, 'time_s': 1.0}]", "found rotor 9"),
    ("name = 'x'\ndef detect(*a): raise ValueError('no')", "x failed on"),
])  # fmt: skip
def test_a_bad_detector_is_one_sentence(flights, tmp_path, text, says):
    (tmp_path / "bad.py").write_text(text)
    rule = str(tmp_path / "bad.py")
    try:
        result = evaluate.evaluate([{"path": str(cli.SAMPLES / QUAD)}], jobs=1, detector=rule)
    except ConfigError as why:
        assert says in str(why)
    else:
        assert says in result["flights"][0]["sentence"]
