"""Many things by one way: in line, in processes that may die, and by a real Dask cluster whose parts are killed."""

import os
import pickle
import signal
import socket
import subprocess
import sys
import threading
import time
import warnings
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from tests import misbehaving

from many_work import building, number, work
from rotorwatch.base import many
from rotorwatch.base.many import cluster, processes
from rotorwatch.base.many.done import Task
from rotorwatch.base.many.limited import Workers
from rotorwatch.base.many.result_cache import ResultCache
from rotorwatch.errors import BackendWarning, ConfigError, LogError, WorkerError

ROOT = Path(__file__).parents[1]


@pytest.mark.parametrize("action", ["always", "ignore"])
def test_processes_say_what_they_build_unless_warnings_are_hushed(action, capfd):
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        warnings.filterwarnings(action, category=BackendWarning)
        warnings.filterwarnings("ignore", message="size changed")  # as NumPy does: of that text only
        assert len(list(processes.run(building, (Task(k, k) for k in range(3)), 1, 1))) == 3
    assert capfd.readouterr().err.splitlines() == ["rotorwatch: Building something."] * (action == "always")


def begun(folder):
    path = Path(folder) / "begun.txt"
    return Counter(int(line) for line in path.read_text().split()) if path.exists() else Counter()


@pytest.mark.parametrize("jobs", [1, 2])
def test_what_is_kept_is_not_done_again(tmp_path, jobs):
    keep = tmp_path / "kept"
    items = [(str(tmp_path), "fine", k) for k in range(6)] + [(str(tmp_path), "error", 6)]
    got = []
    with pytest.raises(LogError, match="6: no log"):
        for value in many.ordered(number, items, jobs, keep=keep):
            got.append(value)
    assert got == list(range(6)) and begun(tmp_path) == Counter(range(7))
    shares = []
    fine = [*items[:6], (str(tmp_path), "fine", 7)]
    assert list(many.ordered(number, fine, jobs, keep=keep, progress=shares.append)) == [*range(6), 7]
    assert begun(tmp_path) == Counter([*range(7), 7]) and shares == list(range(1, 8))
    assert list(many.ordered(number, fine, jobs, keep=keep)) == [*range(6), 7]
    assert begun(tmp_path)[7] == 1


def test_what_is_kept_belongs_to_one_function_one_item_and_one_file(tmp_path):
    log = tmp_path / "a.log"
    log.write_text("one")
    keep = tmp_path / "kept"

    def kept(function, item):
        return ResultCache(keep, function).load(item)

    store = ResultCache(keep, number)
    store.save((str(log), "fine", 1), {"value": np.arange(3.0)})
    assert np.array_equal(kept(number, (str(log), "fine", 1))[0]["value"], np.arange(3.0))
    assert kept(work, (str(log), "fine", 1)) is None and kept(number, (str(log), "fine", 2)) is None
    place = store.place((str(log), "fine", 1))
    place.write_bytes(pickle.dumps(os.system))  # a file that would run something, a torn one, and none
    assert kept(number, (str(log), "fine", 1)) is None
    place.write_bytes(b"torn")
    assert kept(number, (str(log), "fine", 1)) is None
    store.save((str(log), "fine", 1), None)
    assert kept(number, (str(log), "fine", 1)) == (None,)
    log.write_text("another")
    assert kept(number, (str(log), "fine", 1)) is None
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match="is a file, not a folder"):
        next(many.ordered(number, [1], 1, keep=tmp_path / "file"))


def answers(done):
    return {d.index: d.value if d.error is None else type(d.error).__name__ for d in done}


# Processes of this computer


def test_what_dies_is_begun_again_and_errors_are_kept(tmp_path):
    kinds = ["fine"] * 12
    kinds[3], kinds[4], kinds[5], kinds[6], kinds[9] = "error", "die once", "die", "unfriendly", "unpackable"
    found = list(many.run(number, [(tmp_path, kind, k) for k, kind in enumerate(kinds)], jobs=2))
    assert sorted(d.index for d in found) == list(range(12))
    wanted = {k: k for k in range(12)} | {3: "LogError", 5: "WorkerError", 6: "RuntimeError", 9: "RuntimeError"}
    assert answers(found) == wanted
    errors = {d.index: d.error for d in found if d.error}
    assert str(errors[3]) == "3: no log" and str(errors[6]) == "Unfriendly: 6 and more"
    assert "exit code 7) 2 times" in str(errors[5]) and errors[5].how == "died (exit code 7)"
    assert "in work" in errors[6].__notes__[0]  # where it happened
    assert begun(tmp_path) == Counter(dict.fromkeys(range(12), 1) | {4: 2, 5: 2})
    alone = [(tmp_path, kind if kind == "error" else "fine", k) for k, kind in enumerate(kinds)]
    assert answers(many.run(number, alone, jobs=1)) == dict(enumerate(range(12))) | {3: "LogError"}


@pytest.mark.thorough
@settings(max_examples=6, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.sampled_from(["fine", "error", "die once"]), min_size=2, max_size=9))
def test_jobs_change_no_answer(tmp_path_factory, kinds):
    several, one = tmp_path_factory.mktemp("several"), tmp_path_factory.mktemp("one")
    alone = [("fine" if kind == "die once" else kind) for kind in kinds]
    expected = answers(many.run(number, [(one, kind, k) for k, kind in enumerate(alone)], jobs=1))
    assert answers(many.run(number, [(several, kind, k) for k, kind in enumerate(kinds)], jobs=2)) == expected


def test_items_are_taken_when_there_is_room(tmp_path):
    taken = []

    def endless():
        k = 0
        while True:
            taken.append(k)
            yield tmp_path, "fine", k
            k += 1

    results = many.run(number, endless(), jobs=2)
    seen = [next(results).index for _ in range(20)]
    assert len(set(seen)) == 20 and len(taken) <= 24
    results.close()
    assert sum(begun(tmp_path).values()) <= len(taken)


def test_order_is_kept_where_it_is_asked_for(tmp_path):
    reported = []
    items = [(tmp_path, "slow" if k == 0 else "fine", k) for k in range(8)]
    assert list(many.ordered(number, items, jobs=2, progress=reported.append)) == list(range(8))
    assert reported == list(range(1, 9))
    with pytest.raises(LogError, match="1: no log"):
        list(many.ordered(number, [(tmp_path, "fine", 0), (tmp_path, "error", 1)], jobs=1))


def test_one_process_is_asked_one_thing_after_another():
    worker = processes.Worker(pickle.dumps((abs, None)), 5.0)
    try:
        assert worker.call(-3) == 3
        with pytest.raises(TypeError):
            worker.call("three")
        assert worker.alive and worker.call(-4) == 4
    finally:
        worker.stop()


@pytest.mark.parametrize(("function", "item", "says"), [(os._exit, 7, r"exit code 7"), (time.sleep, 60, "hung for 0.1 s")])
def test_a_process_that_dies_or_hangs_over_a_question_is_gone(function, item, says):
    worker = processes.Worker(pickle.dumps((function, None)), 0.1)
    with pytest.raises(WorkerError, match=says):
        worker.call(item)
    assert worker.ready and not worker.alive


def test_processes_that_do_not_start_are_reported(monkeypatch, tmp_path):
    monkeypatch.setattr(processes, "_serve", os._exit)  # called with a pipe, it ends at once
    with pytest.raises(WorkerError, match=r"while starting.*__main__"):
        list(many.run(number, [(tmp_path, "fine", k) for k in range(3)], jobs=2))


SCRIPT = """
import sys, time
from pathlib import Path
from rotorwatch import many

def slow(k):
    time.sleep(0.05)
    with open(sys.argv[1], "a") as file:
        file.write(f"{k}\\n")
    return k

if __name__ == "__main__":
    for done in many.run(slow, range(10**9), 2):
        print(done.value, flush=True)
"""


@pytest.mark.parametrize("blow", [signal.SIGINT, signal.SIGKILL])
def test_no_process_outlives_the_one_that_started_it(tmp_path, blow):
    script, noted = tmp_path / "endless.py", tmp_path / "done.txt"
    script.write_text(SCRIPT)
    environment = {**os.environ, "PYTHONPATH": str(ROOT / "src")}
    process = subprocess.Popen(
        [sys.executable, script, noted], env=environment, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    )
    shown = [process.stdout.readline() for _ in range(3)]
    process.send_signal(blow)
    process.stdout.close()
    process.wait(20)
    time.sleep(0.2)
    before = noted.read_text()
    time.sleep(0.3)
    assert all(shown) and noted.read_text() == before


@pytest.mark.parametrize(
    ("given_", "says"),
    [
        ({"jobs": 0}, "jobs must be at least 1"),
        ({"jobs": 2, "scheduler": "tcp://a:1"}, "not both"),
        ({"scheduler": "here"}, "give the address of a Dask scheduler"),
    ],
)
def test_arguments_that_do_not_fit_are_refused(given_, says):
    with pytest.raises(ConfigError, match=says):
        many.run(number, [], **given_)


def test_without_dask_one_sentence(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(ConfigError, match="pip install distributed"):
        many.run(number, [], scheduler="tcp://127.0.0.1:8786")


# A cluster


@pytest.fixture(scope="module")
def start():
    """Start the scheduler (first) or a worker: start("scheduler") -> process. All of them end with the module."""
    pytest.importorskip("distributed")
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    here, started = f"tcp://127.0.0.1:{port}", []
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT / "src"), str(ROOT / "tests")])}

    def go(what):
        command = [sys.executable, "-m", f"distributed.cli.dask_{what}"]
        if what == "scheduler":
            command += ["--host", "127.0.0.1", "--port", str(port), "--no-dashboard"]
        else:
            command += [here, "--nthreads", "1", "--no-nanny", "--no-dashboard"]
        started.append(subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL))
        until = time.monotonic() + 120  # a busy computer takes its time
        while what == "scheduler" and time.monotonic() < until:
            with suppress(OSError), socket.create_connection(("127.0.0.1", port), 1.0):
                break
            time.sleep(0.05)
        return started[-1]

    go.address = here
    yield go
    for process in started:
        process.kill()
        process.wait()


def test_a_cluster_that_loses_workers_and_its_scheduler(start, tmp_path):
    """One worker is killed after the third answer, the scheduler after the tenth; new ones come. Every item has one answer."""
    boss, hands = start("scheduler"), [start("worker"), start("worker")]
    kinds = ["slow"] * 24
    kinds[2], kinds[4] = "error", "unfriendly"
    items = [(str(tmp_path), kind, k) for k, kind in enumerate(kinds)]
    found = []
    with pytest.warns(match="scheduler at .* was lost"):
        for done in many.run(number, items, scheduler=start.address):
            found.append(done)
            if len(found) == 3:
                hands[0].kill()
                hands.append(start("worker"))
            if len(found) == 10:
                boss.kill()
                boss.wait()
                boss, hands = start("scheduler"), [start("worker"), start("worker")]
    assert sorted(d.index for d in found) == list(range(24))
    assert answers(found) == {k: k for k in range(24)} | {2: "LogError", 4: "RuntimeError"}
    assert max(begun(tmp_path).values()) <= 3  # in flight when something was killed, else once
    assert sum(begun(tmp_path).values()) <= 24 + 1 + cluster.LEAST


def test_an_item_that_kills_every_worker_is_given_up(monkeypatch):
    class KilledWorker(Exception):
        pass

    assert isinstance(cluster._error(KilledWorker()), WorkerError)
    assert "need the same Python" in str(cluster._error(ImportError("no module")))


def test_a_scheduler_that_does_not_answer_is_reported(monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr(cluster, "ANSWER_S", 0.2)
    with pytest.raises(ConfigError, match=r"No Dask scheduler answers at tcp://127\.0\.0\.1:1"):
        list(many.run(number, [(".", "fine", 0)], scheduler="tcp://127.0.0.1:1"))


def test_workers_of_another_version_are_refused():
    said = cluster._do(pickle.dumps(number), None, "9.9")
    assert "has rotorwatch" in str(pickle.loads(said)[1])


def test_only_the_thread_that_uses_a_process_closes_its_pipe(monkeypatch):
    closed = []
    stop = processes.Worker.stop

    def counted(worker):
        closed.append(threading.get_ident())
        stop(worker)

    monkeypatch.setattr(processes.Worker, "stop", counted)
    workers = Workers(misbehaving.endless, 60.0, 500)
    with ThreadPoolExecutor(1) as pool:
        waiting = pool.submit(workers.call, None)
        while not (workers._all and workers._all[0].ready):
            time.sleep(0.01)
        workers.stop()
        with pytest.raises(WorkerError, match="died"):
            waiting.result()
    assert closed and threading.get_ident() not in closed
