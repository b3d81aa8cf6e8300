"""`dwell keys`: what it prints, and what it refuses."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.cli.small_cell import assert_refused, call, read_json

CELL = "examples/canonical.yaml"


def run(*words: str | Path) -> tuple[int, str]:
    result = call("keys", *words)
    return result.exit_code, result.output


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    code, printed = run("init", CELL, "--out", tmp_path / "keys")
    assert code == 0, printed
    return tmp_path / "keys"


def listed(folder: Path) -> dict[str, dict[str, object]]:
    subjects: dict[str, dict[str, object]] = read_json(call("keys", "show", folder, "--json"))[
        "subjects"
    ]
    return subjects


def test_init_makes_a_keyring_for_everybody(folder: Path) -> None:
    assert set(listed(folder)) == {"R1", "E", "R2", "controller", "operator"}
    code, printed = run("show", folder / "R1")
    assert code == 0
    (line,) = (line for line in printed.splitlines() if "this keyring" in line)
    assert line.split()[0] == "R1"
    assert max(map(len, printed.splitlines())) <= 100


def test_init_replaces_nothing(folder: Path) -> None:
    before = (folder / "ca" / "key.pem").read_bytes()
    code, printed = run("init", CELL, "--out", folder)
    assert (code, "has an authority already" in printed) == (2, True)
    assert (folder / "ca" / "key.pem").read_bytes() == before


def test_revoke_and_issue(folder: Path) -> None:
    assert run("revoke", folder, "R1")[0] == 0
    assert "R1" not in listed(folder)
    assert "say its role" in run("issue", folder, "R1")[1]
    code, printed = run("issue", folder, "R1", "--role", "node", "--days", "10")
    assert code == 0
    assert "in 10 days" in printed
    assert listed(folder)["R1"]["generation"] == 2
    assert run("issue", folder, "eve", "--role", "observer")[0] == 0
    assert listed(folder)["eve"]["role"] == "observer"


def test_keys_are_requested_and_signed(folder: Path, tmp_path: Path) -> None:
    code, printed = run("request", "R1", "controller", "--out", tmp_path / "host")
    assert code == 0
    assert "dwell keys sign R1.csr controller.csr" in printed
    requests = sorted((tmp_path / "host").glob("*.csr"))
    code, printed = run("sign", *requests, "--authority", folder)
    assert code == 0
    assert {name: listed(folder)[name]["generation"] for name in ("R1", "controller", "E")} == {
        "R1": 2,
        "controller": 2,
        "E": 1,
    }
    assert run("request", "eve", "--out", tmp_path / "host")[0] == 0
    words = ("sign", tmp_path / "host" / "eve.csr", "--authority", folder)
    assert "say its role" in run(*words)[1]
    assert run(*words, "--role", "observer", "--days", "3")[0] == 0
    assert listed(folder)["eve"]["days"] == 3


def test_mistakes(folder: Path, tmp_path: Path) -> None:
    for words, said in {
        ("show", tmp_path / "none"): "ca.pem: cannot be read",
        ("revoke", folder, "R7"): "no subject 'R7'",
        ("issue", folder, "x y", "--role", "node"): "no name of a subject",
        ("issue", folder, "x", "--role", "king"): "no role 'king'",
        ("issue", folder, "R1", "--days", "0"): "days is 0",
        ("issue", folder, "R1", "--address", "\u00e9\u2603"): "neither a host",
    }.items():
        assert_refused(call("keys", *words), said)
