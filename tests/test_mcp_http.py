"""`rotorwatch mcp --http`: the same over a port of this computer, for who knows the token."""

from __future__ import annotations

import json
import signal
import subprocess

import pytest

pytest.importorskip("mcp")

import httpx2
from mcp.client.streamable_http import streamable_http_client

from mcp_client import COMMAND, CURRENT, ENVIRONMENT, PREVIOUS, Session
from mcp_texts import tokens
from rotorwatch.commands.cli import SAMPLES

TOKEN = "0123456789abcdef0123"
FPV = "fpv_motor_3_stops.bbl.xz"
ASK = {
    "jsonrpc": "2.0", "id": 1, "method": "initialize",
    "params": {"protocolVersion": PREVIOUS, "capabilities": {}, "clientInfo": {"name": "x", "version": "1"}},
}  # fmt: skip
TAKES = {"Accept": "application/json, text/event-stream", "Content-Type": "application/json"}
KNOWN = TAKES | {"Authorization": f"Bearer {TOKEN}"}


@pytest.fixture(scope="module")
def address():
    """The address that the command prints."""
    words = [*COMMAND, str(SAMPLES), "--http", "--port", "0"]
    server = subprocess.Popen(words, env=ENVIRONMENT | {"ROTORWATCH_TOKEN": TOKEN}, stdout=subprocess.PIPE, text=True)
    assert server.stdout
    address = server.stdout.readline().strip()
    assert address.startswith("http://127.0.0.1:") and address.endswith("/mcp"), address
    yield address
    server.send_signal(signal.SIGTERM)
    assert server.wait(20) == 0
    server.stdout.close()


@pytest.mark.parametrize("version", [CURRENT, PREVIOUS])
def test_a_question_over_http(address, version):
    asking = httpx2.AsyncClient(headers={"Authorization": f"Bearer {TOKEN}"}, timeout=60.0)
    session = Session(streamable_http_client(address, http_client=asking), version)
    try:
        assert session.client.protocol_version == version
        answer = session.call("diagnose", log=FPV)
        assert answer["headline"].startswith("Motor 3 (rear left) desynced 2 times") and tokens(answer.text) < 1500
        assert session.call("diagnose", log="../../../etc/passwd").failed
        assert session.read("rotorwatch://glossary/onset").startswith("onset")
    finally:
        session.close()


@pytest.mark.parametrize(
    ("code", "changes"),
    [
        (200, {}),
        (401, {"Authorization": None}),
        (401, {"Authorization": ""}),
        (401, {"Authorization": "Bearer"}),
        (401, {"Authorization": "Bearer wrong"}),
        (401, {"Authorization": f"Bearer {TOKEN}x"}),
        (401, {"Authorization": f"Bearer {TOKEN[:-1]}"}),
        (401, {"Authorization": f"Basic {TOKEN}"}),
        (401, {"Authorization": TOKEN}),
        (401, {"Authorization": None, "Cookie": f"rotorwatch={TOKEN}"}),
        (421, {"Host": "evil.example"}),
        (421, {"Host": "127.0.0.1.evil.example"}),
        (421, {"Host": "10.0.0.1"}),
        (421, {"Host": "localhost@evil.example"}),
        (421, {"Host": "127.0.0.1:x"}),
        (200, {"Host": "localhost:80"}),
        (403, {"Origin": "https://evil.example"}),
        (403, {"Origin": "null"}),
        (403, {"Origin": "http://localhost:1"}),
        (403, {"Sec-Fetch-Site": "cross-site"}),
        (400, {"Content-Type": "text/plain"}),
    ],
)
def test_who_may_ask(address, code, changes):
    headers = {k: v for k, v in (KNOWN | changes).items() if v is not None}
    answer = httpx2.post(address, json=ASK, headers=headers)
    assert answer.status_code == code, answer.text
    if code in (401, 403, 421):
        assert answer.json()["error"].endswith(".") and TOKEN not in answer.text
        assert ("www-authenticate" in answer.headers) == (code == 401)


def test_a_token_in_the_address_is_none(address):
    assert httpx2.post(f"{address}?token={TOKEN}", json=ASK, headers=TAKES).status_code == 401


def test_requests_are_bounded(address):
    assert httpx2.post(address, content=json.dumps(ASK | {"x": "x" * (1 << 19)}), headers=KNOWN).status_code == 413
    assert httpx2.post(address, content=b"{" * 1000, headers=KNOWN).status_code == 400
    assert httpx2.get(address.replace("/mcp", "/other"), headers=KNOWN).status_code == 404
