"""Batches as Zenoh 1.10.2 sends them, and as it might."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dwell.demo.link_batches import Sifter, is_session
from tests.demo.link_wire import DECLARE, INIT, KEEP_ALIVE, fragments, frame, framed, push

# As captured between two sessions.
CAPTURED_DATA = {
    "attachment": "25be8cf3243d01042f696d6781430368647214" + 20 * "78",
    "priority": "a5be8cf3243101bd01022f612111010a79797979797979797979",
    "timestamp, encoding": "25bf8cf3243d01022f6161bcbde9fb83c7d4806b10"
    "e21225cce93af9db3502688c35b756d10901730a79797979797979797979",
    "delete": "25c08cf3243d01022f6102",
}
CAPTURED_SESSION = {
    "init": "c109f1e21225cce93af9db3502688c35b756d10ac8ff81c205b7a6a69c0e2701",
    "open": "e20a95ee81404209010001020304050607",
    "interest": "a5be8cf3243100be0021081a",
    "declare": "a595ee814031009e210820010001749e2108620101032f2a2abe0021081a",
    "keep-alive": "04",
}


def always() -> bool:
    return True


def never() -> bool:
    return False


def from_list(decisions: list[bool]) -> Callable[[], bool]:
    left = iter(decisions)
    return lambda: next(left)


@pytest.mark.parametrize("hexadecimal", CAPTURED_DATA.values(), ids=CAPTURED_DATA)
def test_data_may_be_lost(hexadecimal: str) -> None:
    batch = bytes.fromhex(hexadecimal)
    lost = Sifter().sift(batch, always)
    assert (lost.batch, lost.data, lost.lost) == (b"", 0, 1)
    kept = Sifter().sift(batch, never)
    assert (kept.batch, kept.data, kept.lost) == (batch, 1, 0)


@pytest.mark.parametrize("hexadecimal", CAPTURED_SESSION.values(), ids=CAPTURED_SESSION)
def test_what_keeps_the_session_is_never_lost(hexadecimal: str) -> None:
    batch = bytes.fromhex(hexadecimal)
    sifted = Sifter().sift(batch, always)
    assert (sifted.batch, sifted.data, sifted.lost) == (batch, 0, 0)


def test_data_before_a_declaration_is_lost_without_it() -> None:
    batch = frame([push(b"a"), push(b"b"), DECLARE])
    sifted = Sifter().sift(batch, from_list([True, False]))
    assert sifted.batch == frame([push(b"b"), DECLARE])
    assert Sifter().sift(batch, always).batch == frame([DECLARE])


@given(
    st.lists(
        st.lists(st.tuples(st.binary(max_size=300), st.booleans()), min_size=1, max_size=5),
        min_size=1,
        max_size=4,
    ),
    st.sampled_from([None, 1, 5, 7]),
    st.booleans(),
)
def test_what_is_left_is_as_if_the_lost_had_not_been_sent(
    frames: list[list[tuple[bytes, bool]]], priority: int | None, alive: bool
) -> None:
    def batch_of(*, whole: bool) -> bytes:
        parts = []
        for sn, messages in enumerate(frames):
            left = [push(payload) for payload, lost in messages if whole or not lost]
            parts.append(frame(left, 10_000 * sn, priority) if left else b"")
        return b"".join(parts) + (KEEP_ALIVE if alive else b"")

    decisions = [lost for messages in frames for _, lost in messages]
    sifted = Sifter().sift(batch_of(whole=True), from_list(decisions))
    assert sifted.batch == batch_of(whole=False)
    assert (sifted.data, sifted.lost) == (decisions.count(False), decisions.count(True))


@given(st.lists(st.booleans(), min_size=1, max_size=6))
def test_all_fragments_of_a_message_are_lost_or_none(decisions: list[bool]) -> None:
    sifter = Sifter()
    lose = from_list(decisions)
    for index, lost in enumerate(decisions):
        batches = fragments(push(bytes([index]) * 300), 100, sn=10 * index)
        sifted = [sifter.sift(batch, lose) for batch in batches]
        assert [item.batch for item in sifted] == ([b""] * 4 if lost else batches)
        assert sum(item.data for item in sifted) == (not lost)
        assert sum(item.lost for item in sifted) == lost
        assert len({id(item.chain) for item in sifted}) == 1


def test_messages_of_two_priorities_pass_in_fragments_at_the_same_time() -> None:
    sifter = Sifter()
    high = fragments(push(b"h" * 200), 100, priority=1)
    low = fragments(push(b"l" * 200), 100, priority=6)
    lose = from_list([True, False])
    kept = [
        sifter.sift(batch, lose).batch for pair in zip(high, low, strict=True) for batch in pair
    ]
    assert [batch for batch in kept if batch] == low


def test_a_large_declaration_in_fragments_is_not_lost() -> None:
    sifter = Sifter()
    batches = fragments(DECLARE * 10, 100)
    assert [sifter.sift(batch, always).batch for batch in batches] == batches


def test_fragments_without_a_beginning_are_left_alone() -> None:
    batches = fragments(push(b"\x3d" * 300), 100)[1:]
    assert [Sifter().sift(batch, always).batch for batch in batches] == batches


def test_a_message_given_up_by_its_sender_is_not_counted() -> None:
    sifter = Sifter()
    first, second, *_ = fragments(push(b"x" * 300), 100)
    given_up = bytes([0x80 | second[0]]) + second[1:2] + b"\x03"
    sifted = [sifter.sift(batch, never) for batch in (first, given_up)]
    assert [item.batch for item in sifted] == [first, given_up]
    assert sum(item.data + item.lost for item in sifted) == 0


@given(st.binary(max_size=200))
def test_anything_else_goes_on_as_it_is(batch: bytes) -> None:
    assert Sifter().sift(batch, never).batch == batch
    Sifter().sift(batch, always)


def test_what_a_session_begins_with() -> None:
    assert is_session(framed([INIT]))
    assert is_session(b"\x20\x00\x01") is None
    assert is_session(b"GET / HTTP") is False
    assert is_session(bytes.fromhex("16030100fa010000f60303")) is False  # TLS
