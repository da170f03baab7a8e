"""`rotorwatch diagnose` over several logs: lines and pages as the answers come, at the end a table, worst first."""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from typing import IO, Any, NamedTuple

import click

from rotorwatch import __version__
from rotorwatch.base import optional
from rotorwatch.commands.tools import counting, label, print_json, say, show
from rotorwatch.errors import ConfigError

# Of several logs the most severe answer is the exit code: error, fault, undecided, healthy.
SEVERITY = (2, 1, 3, 0)
KEYS = ("path", "exit_code", "size", "sha256")  # first keys of a line of --jsonl


class Request(NamedTuple):
    """The options of `rotorwatch diagnose` by name. logs: those found; others: number of files that were none; tuned: the content of
    --tuning; pages, recordings, posts: paths by log of --report, --mcap and --markdown; document: path of --markdown for one post of all,
    or -."""

    logs: Sequence[Any]
    baselines: Sequence[Path]
    vehicle: Path | None
    estimator: str
    tuning: Path | None
    matters: float
    report: Path | None
    html: Path | None
    mcap: Path | None
    parquet: Path | None
    markdown: Path | None
    identify: bool
    line: bool
    verbose: bool
    as_json: bool
    jsonl: bool
    out: Path | None
    resume: bool
    jobs: int | None
    scheduler: str | None
    quiet: bool
    others: int = 0
    tuned: Any = None
    pages: Sequence[Path] = ()
    recordings: Sequence[Path] = ()
    posts: Sequence[Path] = ()
    document: Path | None = None

    @property
    def to_stdout(self) -> bool:
        """--markdown goes to standard output."""
        return str(self.markdown) == "-"


def settings(estimator: str, matters: float, *files: Path | None) -> str:
    """A digest of everything but the logs that the answers depend on: this version, the estimator, --matters, and files."""
    import hashlib

    digest = hashlib.sha256(f"{__version__}\0{estimator}\0{matters!r}".encode())
    for path in files:
        digest.update(b"\0" + (path.read_bytes() if path and path.is_file() else b"-"))
    return digest.hexdigest()[:12]


def diagnose(request: Request, explain: Callable[[Exception], str]) -> int:
    """Assess all logs; returns the exit code. explain: makes a sentence of an exception. However it ends, the answers so far are shown."""
    from rotorwatch.diagnose_many import Answer, diagnose_many
    from rotorwatch.report import markdown, overview, parquet_tables

    if request.others and not request.quiet:
        say(f"{request.others} other {'file is' if request.others == 1 else 'files are'} not flight logs; skipped.")
    rows, codes, listed = overview.Rows(), set(), {}
    together = markdown.Several(request.identify) if request.document else None
    pictures = bool(request.markdown) and not request.to_stdout and _drawable(request.quiet)
    how = settings(request.estimator, request.matters, request.vehicle, request.tuning, *request.baselines)
    with _lines(request, how) as lines, _tables(request) as tables, counting(request.quiet, "logs") as counter:
        known = {path: line.known for path, line in lines.there.items() if line.known}
        began, total = time.monotonic(), len(request.logs)

        def keep(answer: Answer) -> None:
            if answer.unchanged:
                line = lines.there[answer.path]
                codes.add(line.code)
                rows.add(line.row)
                if together:
                    together.add(line.row)
                return
            if answer.error is not None:
                text = explain(answer.error)
                name = label(request.logs[answer.index])
                sentence = text if name in text or label(answer.path) in text else f"{name}: {text}"
                record = {**answer.to_dict(), "flight": {"name": name}, "error": text}
                say(sentence)
            else:
                record = answer.to_dict()
            codes.add(answer.exit_code)
            if tables is not None:
                tables.add(answer.tables or parquet_tables.failed(answer.path, record["error"]))
            if request.line and answer.diagnosis is not None:
                click.echo(f"{label(request.logs[answer.index])}: {answer.diagnosis.to_line()}")
            page = _write_page(request, answer)
            lines.write(answer, record)
            if request.as_json:
                listed[answer.index] = record
            row = overview.row(label(answer.path), record, page)
            rows.add(row)
            if together:
                together.add(row, answer.diagnosis, answer.parts, answer.picture)
            if counter and answer.diagnosis is not None and not (request.as_json or request.line or lines.streams):
                from rotorwatch.report import terminal

                counter.show(terminal.line(label(request.logs[answer.index]), answer.diagnosis))

        answers = diagnose_many(
            request.logs, request.vehicle, request.baselines, request.estimator, request.tuned, request.jobs, request.scheduler,
            pages=bool(request.html or request.pages), recordings=bool(request.recordings), hashed=request.jsonl, known=known,
            pictures=pictures, matters=request.matters, tables=tables is not None,
        )  # fmt: skip
        try:
            for done, answer in enumerate(answers, start=1):
                keep(answer)
                if counter:
                    counter(done, total, done / max(time.monotonic() - began, 1e-9))
        finally:
            with suppress(ValueError):
                answers.close()  # type: ignore[attr-defined]
            if codes:
                _show(request, rows, [listed[k] for k in sorted(listed)], together)
    return next((code for code in SEVERITY if code in codes), 0)


def _tables(request: Request) -> Any:
    """The writer of --parquet, or a context of nothing."""
    from rotorwatch.report import parquet_tables

    return nullcontext() if request.parquet is None else parquet_tables.Writer(request.parquet)


def _drawable(quiet: bool) -> bool:
    """True if pictures can be drawn; prints why not."""
    try:
        optional.library("matplotlib.figure", "The picture of a post")
    except ConfigError as why:
        if not quiet:
            say(str(why))
        return False
    return True


def _show(request: Request, rows: Any, listed: list[dict[str, Any]], together: Any) -> None:
    """Print and write the summary after the last log."""
    from rotorwatch.report import overview

    if together and not request.to_stdout:
        together.write(request.document)
    if request.as_json:
        print_json(listed)
    elif request.to_stdout:
        click.echo(together.text(), nl=False)
    elif not (request.jsonl or request.line):
        show(lambda terminal: terminal.overview(rows.title(), rows.worst()))
    if request.html:
        overview.write(rows, request.html / "index.html")
    if request.quiet:
        return
    if request.jsonl and request.out:
        say(f"{rows.title()}; answers written to {request.out}")
    if request.html:
        say(f"pages written to {request.html / 'index.html'}")
    elif request.pages:
        say(f"report written to {request.pages[0].parent}")
    if request.posts or (request.document and not request.to_stdout):
        say(f"posts written to {request.posts[0].parent}" if request.posts else f"post written to {request.document}")
    if request.parquet:
        say(f"tables written to {request.parquet}")
    if request.recordings:
        say(f"MCAP files written to {request.recordings[0].parent}")


def _page(request: Request, path: str) -> str | None:
    """The file name of a log's page below --html: its own name, made unique."""
    if not request.html:
        return None
    import hashlib

    name = path.rstrip("/").rpartition("/")[2]
    stem = name.removesuffix(".xz").removesuffix(".gz").removesuffix(".bz2").rpartition(".")[0] or name
    return f"{label(stem)}-{hashlib.sha256(os.fsencode(path)).hexdigest()[:8]}.html"


def _write_page(request: Request, answer: Any) -> str | None:
    """Write the page, the post and the MCAP file of an answer; returns the page's name below --html."""
    from rotorwatch.base import files

    if request.posts and answer.diagnosis is not None:
        from rotorwatch.report import markdown

        markdown.write(answer.diagnosis, request.posts[answer.index], request.identify, answer.picture, answer.parts)
    if answer.recording is not None:
        with files.replacing(request.recordings[answer.index]) as unfinished:
            Path(unfinished).write_bytes(answer.recording)
    if answer.page is None:
        return None
    name = _page(request, answer.path)
    goals = ([request.html / name] if request.html and name else []) + ([request.pages[answer.index]] if request.pages else [])
    for goal in goals:
        with files.replacing(goal) as unfinished:
            Path(unfinished).write_text(answer.page, encoding="utf-8")
    return name


# JSON lines


def _recorded(path: str) -> str:
    """A path for a line of output: of a pipe, its name; undecodable bytes as JSON escapes."""
    name = label(path)
    return path if name == path.encode("utf-8", "backslashreplace").decode() else name


class _Line(NamedTuple):
    """A line of an earlier call. known: None where it has to be made again."""

    code: int
    row: Any
    known: Any


class _Lines:
    """The output of lines, if any, and the lines of an earlier call."""

    def __init__(self, out: IO[bytes] | None, how: str, there: dict[str, _Line]):
        self.out, self.how, self.there = out, how, there
        self.streams = out is not None

    def write(self, answer: Any, found: dict[str, Any]) -> None:
        """Write one line atomically: a kill loses at most the line being computed."""
        if self.out is None:
            return
        about = dict(zip(KEYS, (_recorded(answer.path), answer.exit_code, answer.size, answer.sha256)))
        line = json.dumps({**about, "settings": self.how, **found}, allow_nan=False)
        self.out.write(line.encode() + b"\n")
        self.out.flush()


@contextmanager
def _lines(request: Request, how: str) -> Iterator[_Lines]:
    if not request.jsonl:
        yield _Lines(None, how, {})
    elif request.out is None:
        yield _Lines(getattr(sys.stdout, "buffer", sys.stdout), how, {})  # type: ignore[arg-type]
    else:
        there = _there(request, how)
        with request.out.open("ab") as file:
            yield _Lines(file, how, there)


def _there(request: Request, how: str) -> dict[str, _Line]:
    """The lines of the file that --resume continues, by path; a truncated last line is removed. Raises ConfigError."""
    from rotorwatch.diagnose_many import Known
    from rotorwatch.report import overview

    out = request.out
    assert out is not None
    if not out.exists() or not out.stat().st_size:
        return {}
    if not request.resume:
        raise ConfigError(f"{out} exists already: continue it with --resume, delete it, or give another name.")
    there, whole = {}, 0
    with out.open("rb") as file:
        for number, text in enumerate(file, start=1):
            if not text.endswith(b"\n"):
                break
            try:
                line = json.loads(text)
                path, code, size, sha256 = (line[key] for key in KEYS)
                how_made = line["settings"]
            except (ValueError, TypeError, KeyError):
                raise ConfigError(f"{out}: line {number} is not a diagnosis of rotorwatch; give another file.") from None
            if how_made != how:
                raise ConfigError(f"{out} was made by another version, or with another estimator, vehicle or baseline; give another file.")
            answer = {key: value for key, value in line.items() if key not in KEYS}
            shown = overview.row(label(path), answer, _page(request, path))
            there[path] = _Line(code, shown, None if sha256 is None else Known(size, sha256))
            whole += len(text)
    os.truncate(out, whole)
    return there
