"""Whatever comes from the network is read or refused: no crash, no memory, no stage called."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dwell.errors import LiveError
from dwell.live.wire.messages import MAX_CONTROL_BYTES, MAX_HEADER_BYTES
from dwell.live.wire.payloads import read_payload
from tests.fuzz.targets import TARGETS, seeds

#: What reading may take: an empty map is one byte on the wire, and 64 and a pointer in memory.
BYTES_A_BYTE = 100
BYTES_AT_ALL = 100_000
PIECES = (
    b"\xdd\xff\xff\xff\xff",
    b"\xdf\x0f\xff\xff\xff",
    b"\xdb\xff\xff\xff\xff",
    b"\xc1",
    b"\x91",
)


@st.composite
def broken(draw: st.DrawFn, whole: bytes) -> bytes:
    """A message with some bytes gone, doubled or others, or with something behind it."""
    data = bytearray(whole)
    for _ in range(draw(st.integers(0, 4))):
        at = draw(st.integers(0, len(data)))
        piece = draw(st.binary(max_size=4) | st.sampled_from(PIECES))
        data[at : at + draw(st.integers(0, 6))] = piece
    if draw(st.booleans()):
        del data[draw(st.integers(0, len(data))) :]
    return bytes(data)


def inputs(name: str) -> st.SearchStrategy[bytes]:
    some = st.sampled_from(seeds(name))
    long = st.sampled_from([MAX_HEADER_BYTES + 1, MAX_CONTROL_BYTES + 2, 400_000])
    longer = st.tuples(some, long).map(lambda pair: pair[0] + bytes(pair[1]))
    deep = st.sampled_from([b"\x91", b"\x80", b"\x81\xa1a"]).map(lambda one: one * 20_000)
    return (
        st.binary(max_size=400)
        | some.flatmap(broken)
        | longer
        | st.tuples(some, deep).map(lambda pair: pair[0][:8] + pair[1])
    )


@pytest.mark.parametrize("name", TARGETS)
def test_what_is_whole_is_read(name: str) -> None:
    for seed in seeds(name):
        TARGETS[name](seed)


@pytest.mark.parametrize("name", TARGETS)
def test_any_bytes_are_read_or_refused(name: str) -> None:
    @settings(database=None)
    @given(inputs(name))
    def check(data: bytes) -> None:
        TARGETS[name](data)

    check()


@pytest.mark.parametrize("name", ["message", "header", "payload", "bundle", "seal"])
def test_reading_takes_no_more_memory_than_the_message_is_long(name: str) -> None:
    target = TARGETS[name]
    target(b"")

    @settings(database=None)
    @given(inputs(name))
    def check(data: bytes) -> None:
        assert peak(target, data) <= BYTES_AT_ALL + BYTES_A_BYTE * len(data)

    check()


def peak(target: Callable[[bytes], None], data: bytes) -> int:
    """Most memory that was taken on the way."""
    tracemalloc.start()
    try:
        target(data)
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize(
    "kind",
    [
        "array:<f4:0x99999999999999999999999",  # too long for NumPy, and nothing in it
        "array:(1,:1",  # NumPy reads it as Python
        "array:(2,)f4:0",
        "array:f4,f4:0",
        "array:{'names':['a'],'formats':['O']}:0",
        "array:|O:0",
        "array:<M8[ns]:0",
        "array:<f4:+1",
        "array:<f4:1_0",
        "array:<f4:-0",
    ],
)
def test_no_array_is_described_like_that(kind: str) -> None:
    data = kind.encode()
    TARGETS["payload"](bytes([len(data)]) + data)
    with pytest.raises(LiveError):
        read_payload(kind, b"")
