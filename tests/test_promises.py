"""docs/promises.md: every promise names tests that exist; and the promise that nothing listens or
calls home.
"""

import re
import socket
from pathlib import Path

import pytest

from gftorf_warp.cli import main

REPOSITORY = Path(__file__).parents[1]
PAGE = REPOSITORY / "docs" / "promises.md"
NAMED = re.findall(r"`(tests/\w+\.py)::(test_\w+)`", PAGE.read_text())


@pytest.mark.parametrize(("file", "name"), NAMED, ids=lambda value: value)
def test_the_proof_of_a_promise_exists(file, name):
    """A test of that name is in that file."""
    assert f"\ndef {name}(" in (REPOSITORY / file).read_text()


def test_every_promise_has_a_proof():
    """No row of a table without a test."""
    rows = [line for line in PAGE.read_text().splitlines() if line.startswith("| ")]
    promises = [row for row in rows if not row.startswith(("| we promise", "| attack"))]
    assert len(promises) > 20
    for row in promises:
        assert "::test_" in row, row


def test_no_command_opens_a_socket(tmp_path, monkeypatch):
    """Simulating, checking, fitting, scoring and rendering."""

    class Refused(socket.socket):
        def __init__(self, *_, **__):
            raise AssertionError("a socket was opened")

    monkeypatch.setattr(socket, "socket", Refused)
    monkeypatch.setattr(socket, "getaddrinfo", Refused)
    seq, run, device = str(tmp_path / "seq"), str(tmp_path / "run"), ["--device", "cpu", "-q"]
    words = ["simulate", "demo", "--size", "16x12", "--frames", "4", "--out", seq, "-q"]
    assert main(words) == 0
    assert main(["check", seq, "-q"]) == 0
    fit = ["reconstruct", seq, "--out", run, "--preset", "demo", "--images", "4", *device]
    assert main(fit) == 0
    assert main(["compare", run, *device]) == 0
    assert main(["render", run, "--out", str(tmp_path / "out"), "--times", "0", *device]) == 0
