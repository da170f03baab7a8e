"""A simulator writes into its logs what it broke. Nothing here may look: not in the source, not in what is read."""

import ast
import lzma
import re
import struct
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

import rotorwatch as rw

ROOT = Path(__file__).resolve().parents[1]
SOURCE = ROOT / "src"
SAMPLES = sorted((SOURCE / "rotorwatch" / "samples").glob("*.bin.xz"))
FLIGHTS = ROOT.parent / "shared" / "flights"
TRUTH = re.compile(r"SIM_|SIMSTATE|HIL_STATE|ground_?truth|rfly|ENGINE_FAIL|ENGINE_MUL", re.IGNORECASE)

# The only expressions that may name it, all of them to leave it out.
LEFT_OUT = {
    "k.startswith('SIM_')",
    "name.startswith('SIM_')",
    "'SIM_' not in text",
    "_SIMULATOR = {'SIMSTATE', 'SIM_STATE', 'HIL_STATE', 'HIL_STATE_QUATERNION'}",
}


def mentions(tree):
    """The smallest call, comparison or statement around each string that names a truth; docstrings do not count."""
    found = [n for n in ast.walk(tree) if isinstance(n, ast.Constant) and names_truth(n.value)]
    if not found:
        return
    prose = {
        id(node.body[0].value)
        for node in ast.walk(tree)
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and ast.get_docstring(node, clean=False)
    }
    parent = {child: node for node in ast.walk(tree) for child in ast.iter_child_nodes(node)}
    for node in found:
        if id(node) not in prose:
            while not isinstance(node, ast.Call | ast.Compare | ast.stmt):
                node = parent[node]
            yield ast.unparse(node)


def names_truth(value):
    text = value.decode("latin-1") if isinstance(value, bytes) else value
    return isinstance(text, str) and TRUTH.search(text)


def test_source_names_the_truth_only_to_leave_it_out():
    found = {path: set(mentions(ast.parse(path.read_text()))) - LEFT_OUT for path in SOURCE.rglob("*.py")}
    assert {str(path): names for path, names in found.items() if names} == {}


def test_the_search_finds_what_it_should():
    code = "'''SIM_ in prose'''\nx = parameters['SIM_ENGINE_MUL']\nread(topic=b'rfly_ctrl_lxl')\nok = 'SIMPLE'\n"
    assert list(mentions(ast.parse(code))) == ["x = parameters['SIM_ENGINE_MUL']", "read(topic=b'rfly_ctrl_lxl')"]


def same(a, b):
    """Whether two values of a flight are equal, arrays and dictionaries of signals included."""
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(same(a[k], b[k]) for k in a)
    if isinstance(a, rw.Signal):
        return all(same(getattr(a, f.name), getattr(b, f.name)) for f in fields(a))
    return bool(np.array_equal(a, b)) if isinstance(a, np.ndarray) else a == b


@pytest.mark.parametrize("path", SAMPLES, ids=lambda p: p.name)
def test_other_truth_same_flight(path, tmp_path):
    """A log whose simulator parameters all say something else is read as the same flight."""
    data = bytearray(lzma.open(path).read())
    places = [m.start() for m in re.finditer(rb"SIM_[A-Z0-9_]+\0", bytes(data))]
    for at in places:  # PARM: time, name (16 bytes), value, default
        data[at + 16 : at + 20] = struct.pack("<f", 0.123)
    assert len(places) > 100  # else this log would prove nothing
    (tmp_path / path.stem).write_bytes(data)
    one, other = rw.read(path), rw.read(tmp_path / path.stem)
    for field in fields(one):
        if field.name != "name":
            assert same(getattr(one, field.name), getattr(other, field.name)), field.name


def logs():
    found = sorted((FLIGHTS / "ardupilot-sitl").glob("*.xz")) if FLIGHTS.is_dir() else []
    return [*SAMPLES, *found]


@pytest.mark.thorough(keep=5)
@pytest.mark.parametrize("path", logs(), ids=lambda p: f"{p.parent.name}-{p.name}")
def test_flights_hold_no_truth(path):
    with lzma.open(path) as file:
        assert TRUTH.search(file.read().decode("latin-1")), "this log holds no truth to leave out"
    flight = rw.read(path)
    names = [*flight.parameters, *(name for _, name, _ in flight.parameter_changes), *map(str, flight.facts)]
    names += [m.text for m in flight.messages] + [s.source for s in flight.signals.values()] + list(flight.warnings)
    assert [n for n in names if TRUTH.search(n)] == []
    assert "MOT_THST_EXPO" in flight.parameters or flight.format.lower().startswith("mavlink")
