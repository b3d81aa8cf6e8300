"""Roster: what it accepts, and that no change of it goes unseen."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey
from hypothesis import given
from hypothesis import strategies as st

from dwell.errors import TrustError
from dwell.live.trust.authority import Authority
from dwell.live.trust.roster import ROLES, Roster, Subject
from tests.live.trust.rosters import LIFE


@given(where=st.floats(0, 1, exclude_max=True), change=st.integers(1, 255))
def test_no_changed_roster_is_accepted(
    tmp_path_factory: pytest.TempPathFactory, where: float, change: int
) -> None:
    authority = Authority.create(tmp_path_factory.mktemp("keys") / "keys", "cell")
    authority.issue("R1", "node")
    path = authority.folder / "R1" / "roster.json"
    text = bytearray(path.read_bytes())
    text[int(where * len(text))] ^= change
    before = json.loads(path.read_bytes())
    path.write_bytes(bytes(text))
    key = authority.certificate.public_key()
    assert isinstance(key, Ed25519PublicKey)
    try:
        found = Roster.read(path, key)
    except TrustError:
        return
    # White space, and what JSON may write in two ways, may change; what it says may not.
    assert json.loads(path.read_bytes()) | {"signature": ""} == before | {"signature": ""}
    assert found.number == before["number"]


@given(
    name=st.text(max_size=60),
    role=st.sampled_from([*ROLES, "other"]),
    generation=st.integers(-1, 3),
    serial=st.integers(-1, 3),
)
def test_subjects_are_valid_or_refused(name: str, role: str, generation: int, serial: int) -> None:
    try:
        subject = Subject(name, role, generation, serial, "", *LIFE)  # type: ignore[arg-type]
    except TrustError:
        return
    assert os.sep not in subject.common_name
    assert subject.common_name.count(".") == 1


@pytest.mark.parametrize(
    ("days", "warned_days"), [(3_650, 14), (365, 14), (42, 14), (30, 10), (3, 1)]
)
def test_an_end_is_warned_of_two_weeks_or_a_third_of_the_life_before(
    tmp_path: Path, days: int, warned_days: int
) -> None:
    authority = Authority.create(tmp_path / "keys", "cell", days=days)
    authority.issue("R1", "node", days=days)
    subject = authority.roster.subjects["R1"]
    assert (subject.ends - subject.warns_from).total_seconds() == warned_days * 86_400
