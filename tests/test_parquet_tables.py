"""Answers as Parquet: read by DuckDB, one line a question, and the same as the JSON."""

import json
import re
import sys
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

import rotorwatch as rw
from conftest import hexa_diagnosis
from rotorwatch import gathering
from rotorwatch.commands import cli
from rotorwatch.errors import ConfigError
from rotorwatch.report import parquet_tables

duckdb = pytest.importorskip("duckdb")
DOCS = Path(__file__).parents[1] / "docs" / "parquet.md"
SAMPLES = ("hexax_m3_mul0.80_square_wind.bin.xz", "quadx_healthy_hover.bin.xz")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Three logs: two samples, and one that cannot be read."""
    folder = tmp_path_factory.mktemp("flights")
    for name in SAMPLES:
        (folder / name).write_bytes((cli.SAMPLES / name).read_bytes())
    (folder / "broken.bin").write_bytes(b"\xa3\x95\x80" + bytes(300))
    return folder


@pytest.fixture(scope="module")
def answered(folder, tmp_path_factory):
    """(tables, answers as JSON by log)."""
    out = tmp_path_factory.mktemp("answers")
    with pytest.raises(SystemExit) as left:
        cli.main(["diagnose", str(folder), "--parquet", str(out), "--jsonl", "-o", str(out / "lines"), "--quiet", "--jobs", "2"])
    assert left.value.code == 2  # one could not be read
    lines = [json.loads(line) for line in (out / "lines").read_text().splitlines()]
    return out, {line["path"]: line for line in lines}


def ask(answered, question):
    return duckdb.sql(question.replace("OUT", str(answered[0]))).fetchall()


def test_a_question_is_one_line_of_sql(answered, folder):
    assert ask(answered, "SELECT verdict, count(*) FROM 'OUT/flights.parquet' GROUP BY 1 ORDER BY 1 NULLS LAST") == [
        ("fault", 1), ("healthy", 1), (None, 1),
    ]  # fmt: skip
    ((kind, rotors, onset),) = ask(answered, "SELECT kind, rotors, onset_s FROM 'OUT/events.parquet'")
    assert (kind, rotors) == ("loss_of_effectiveness", [3]) and onset == pytest.approx(47.55, abs=0.1)
    worst = ask(
        answered,
        "SELECT rotor, max(loss_low) FROM 'OUT/losses.parquet' JOIN 'OUT/flights.parquet' USING (log) WHERE verdict = 'fault' "
        "GROUP BY 1 ORDER BY 2 DESC",
    )
    assert worst[0][0] == 3 and len(worst) == 6
    ((log, error),) = ask(answered, "SELECT log, error FROM 'OUT/flights.parquet' WHERE error IS NOT NULL")
    assert log == str(folder / "broken.bin") and "broken.bin" in error


def test_the_numbers_are_those_of_the_json(answered):
    for log, answer in answered[1].items():
        if "error" in answer:
            continue
        ((name, headline, loss, low, status, ticks),) = ask(
            answered,
            "SELECT name, headline, rotor_loss, rotor_loss_low, rotor_status, "
            f"(SELECT count(*) FROM 'OUT/ticks.parquet' WHERE log = '{log}') FROM 'OUT/flights.parquet' WHERE log = '{log}'",
        )
        assert (name, headline) == (answer["flight"]["name"], answer["headline"]) and ticks > 500
        assert loss == pytest.approx([r["loss"] for r in answer["rotors"]], abs=1e-6)
        assert low == pytest.approx([r["interval"][0] for r in answer["rotors"]], abs=1e-6)
        assert status == [r["status"] for r in answer["rotors"]]


def test_ticks_and_losses_are_the_trace(tmp_path):
    diagnosis = rw.diagnose(rw.read(cli.SAMPLES / SAMPLES[0]))
    diagnosis.to_parquet(tmp_path / "out")
    trace, ticks = diagnosis.trace, pq.read_table(tmp_path / "out" / "ticks.parquet")
    assert np.array_equal(ticks["time_s"], trace.time)
    assert np.allclose(ticks["residual_yaw"], trace.residual[:, 2], equal_nan=True) and np.allclose(
        ticks["pitch_deg"], trace.attitude[:, 1]
    )
    assert ticks["pitch_rate_deg_s"].null_count == len(trace.time)  # it is not flown by rates
    time, assessed = trace.time, ticks["assessed"].to_numpy(zero_copy_only=False)
    assert not assessed[time < 11.0].any() and assessed[(time > 12.0) & (time < 100.0)].all()
    third = duckdb.sql(f"SELECT loss, evidence FROM '{tmp_path}/out/losses.parquet' WHERE rotor = 3 ORDER BY time_s").fetchnumpy()
    assert np.allclose(third["loss"], trace.loss[:, 2], atol=1e-6)
    assert np.allclose(np.ma.filled(third["evidence"], np.nan), trace.evidence["rotor 3"], rtol=1e-4, equal_nan=True)


def test_every_column_is_documented_and_every_file_has_the_schema(answered):
    rows = {
        line.split("`")[1]: set(re.findall(r"`(\w+)`", line)) for line in DOCS.read_text().splitlines() if re.match(r"\| `\w+`: ", line)
    }
    for table, columns in parquet_tables.SCHEMAS.items():
        assert set(columns) <= rows[table], table
        assert pq.read_schema(answered[0] / f"{table}.parquet").equals(parquet_tables.schema(table))


def test_tables_of_answers_among_logs_are_no_logs(answered, folder):
    found = gathering.Gathered([folder, answered[0]])
    with pytest.raises(ConfigError, match="holds no flight log"):
        list(found)
    assert found.others == len(parquet_tables.SCHEMAS) + 1


def test_fields_of_a_kind_alone_are_json(tmp_path):
    diagnosis = hexa_diagnosis()
    (event,) = diagnosis.events
    extra = type(event)(**{**vars(event), "extra": {"gives": 1.5}, "alternatives": ((4, 5), (6,))})
    hexa_diagnosis(events=(extra,)).to_parquet(tmp_path)
    ((more, others),) = duckdb.sql(f"SELECT more, alternatives FROM '{tmp_path}/events.parquet'").fetchall()
    assert json.loads(more) == {"gives": 1.5} and others == [[4, 5], [6]]


def test_what_was_assessed_before_an_interruption_is_there(tmp_path):
    with pytest.raises(KeyboardInterrupt), parquet_tables.Writer(tmp_path) as out:
        out.add(parquet_tables.tables(hexa_diagnosis(), "a"))
        out.add(parquet_tables.failed("b/c.bin", "no"))
        raise KeyboardInterrupt
    assert pq.read_table(tmp_path / "flights.parquet")["name"].to_pylist()[1] == "c.bin"
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(f"{table}.parquet" for table in parquet_tables.SCHEMAS)


def test_what_cannot_be_is_said(run, tmp_path, monkeypatch):
    code, _, err = run("diagnose", cli.SAMPLES, "--parquet", tmp_path, "--jsonl", "-o", tmp_path / "x", "--resume")
    assert code == 2 and "exclude each other" in err
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(ConfigError, match="pip install pyarrow"):
        parquet_tables.Writer(tmp_path)
    code, _, err = run("diagnose", cli.SAMPLES, "--parquet", tmp_path)
    assert code == 2 and "pip install pyarrow" in err
