"""What a link makes of packets."""

from __future__ import annotations

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dwell_lab.testbed.packets import Kind, kind_of

A, B = bytes([10, 0, 0, 1]), bytes([10, 0, 0, 2])
ACK, SYN = 0x10, 0x02


def ip(protocol: int, rest: bytes, *, target: bytes = B, fragment: int = 0) -> bytes:
    total = 20 + len(rest)
    return (
        struct.pack("!BBHHHBBH", 0x45, 0, total, 1, fragment, 64, protocol, 0) + A + target + rest
    )


def tcp(port: int, payload: bytes, flags: int = ACK) -> bytes:
    return ip(6, struct.pack("!HHIIBBHHH", port, 80, 0, 0, 0x50, flags, 0, 0, 0) + payload)


def udp(port: int, payload: bytes = b"x") -> bytes:
    return ip(17, struct.pack("!HHHH", port, 80, 8 + len(payload), 0) + payload)


def flow(packet: bytes) -> bytes:
    kind = kind_of(packet)
    assert kind is not None
    return kind.flow


def carries(packet: bytes) -> bool:
    kind = kind_of(packet)
    assert kind is not None
    return kind.data


def test_a_flow_is_a_5_tuple() -> None:
    assert flow(tcp(1, b"a")) == flow(tcp(1, b"bcd"))
    assert len({flow(tcp(1, b"a")), flow(tcp(2, b"a")), flow(udp(1)), flow(udp(2))}) == 4


def test_a_bare_acknowledgement_is_no_data_and_a_flow_of_its_own() -> None:
    bare, data = tcp(1, b""), tcp(1, b"a")
    assert not carries(bare)
    assert carries(data)
    assert carries(tcp(1, b"", SYN | ACK))
    assert flow(bare) != flow(data)


def test_fragments_of_a_datagram_are_one_flow() -> None:
    first = ip(17, struct.pack("!HHHH", 1, 80, 70_000 % 65_536, 0) + bytes(100), fragment=0x2000)
    last = ip(17, bytes(50), fragment=200)
    assert flow(first) == flow(last)


@pytest.mark.parametrize(
    "packet",
    [
        bytes([0x60]) + bytes(47),  # IPv6: a router solicitation
        ip(2, bytes(8), target=bytes([224, 0, 0, 22])),  # IGMP
        ip(17, bytes(20), target=bytes([239, 1, 1, 1])),
        ip(17, bytes(20), target=bytes([255] * 4)),
        ip(132, bytes(20)),
        b"",
    ],
)
def test_the_kernels_own_packets_are_nobodys(packet: bytes) -> None:
    assert kind_of(packet) is None


@given(st.binary(max_size=80))
def test_no_packet_is_too_odd(packet: bytes) -> None:
    assert isinstance(kind_of(packet), Kind | None)
    kind_of(b"\x45" + packet)
