from __future__ import annotations

from dwell.live.wire import relay_batch
from dwell.live.wire.relay_batch import RelayBatch


def test_messages_are_taken_in_their_order_and_once() -> None:
    batch = RelayBatch()
    assert batch.add("a", b"1")
    assert batch.add("b", b"2")
    assert batch.add("a", b"3")
    assert batch.taken() == [("a", b"1"), ("b", b"2"), ("a", b"3")]
    assert batch.taken() == []
    assert len(batch) == 0


def test_where_the_newest_counts_it_takes_the_place_of_the_last() -> None:
    batch = RelayBatch(newest=True)
    for payload in (b"1", b"22", b"333"):
        assert batch.add("a", payload)
    assert batch.add("b", b"")
    assert batch.taken() == [("a", b"333"), ("b", b"")]


def test_one_key_does_not_take_the_room_of_all() -> None:
    batch = RelayBatch()
    taken = [batch.add("loud", b"x") for _ in range(relay_batch.MOST_OF_A_KEY + 5)]
    assert taken.count(True) == relay_batch.MOST_OF_A_KEY
    assert batch.add("quiet", b"x")


def test_what_is_too_long_or_too_much_is_not_carried() -> None:
    batch = RelayBatch(most=2)
    assert not batch.add("k" * (relay_batch.LONGEST_KEY + 1), b"")
    assert not batch.add("k", b"x" * (relay_batch.LONGEST_MESSAGE + 1))
    assert batch.add("a", b"")
    assert batch.add("b", b"")
    assert not batch.add("c", b"")


def test_bytes_are_bounded_and_room_comes_back() -> None:
    batch = RelayBatch(most=10_000)
    payload = b"x" * relay_batch.LONGEST_MESSAGE
    added = 0
    while batch.add(f"key-{added}", payload):
        added += 1
    assert (added + 1) * len(payload) > relay_batch.MOST_BYTES - 100 * added
    batch.taken()
    assert batch.add("again", payload)
