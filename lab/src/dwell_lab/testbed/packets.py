"""Packets on an emulated link: the flow of a packet, and whether it carries data."""

from __future__ import annotations

from typing import NamedTuple

ICMP, TCP, UDP = 1, 6, 17
FIN_SYN_RST = 0x07
# Flag "more fragments" and offset of the fragment; without the flag "don't fragment".
FRAGMENT = 0x3FFF
MULTICAST = 224
LEAST_BYTES = 20
TCP_BYTES = 20


class Kind(NamedTuple):
    """Kind of a packet.

    Parameters
    ----------
    flow : bytes
        Equal for all packets of a 5-tuple, except that bare TCP acknowledgements form a separate
        flow.
    data : bool
        Whether the packet may be part of a message; false for bare acknowledgements.
    """

    flow: bytes
    data: bool


def kind_of(packet: bytes) -> Kind | None:
    """Return a packet's kind; None for the kernel's own packets on every interface.

    These are IPv6 packets (router solicitations, neighbours, listeners), multicast, broadcast, and
    all protocols except TCP, UDP and ICMP.

    Parameters
    ----------
    packet : bytes
        Packet from a TUN device without packet information.
    """
    if len(packet) < LEAST_BYTES or packet[0] >> 4 != 4:
        return None
    protocol = packet[9]
    if packet[16] >= MULTICAST or protocol not in (TCP, UDP, ICMP):
        return None
    addresses = packet[9:10] + packet[12:20]
    begin = (packet[0] & 0x0F) * 4
    whole = not int.from_bytes(packet[6:8], "big") & FRAGMENT
    if protocol == ICMP or not whole:
        # Only the first fragment has the ports.
        return Kind(addresses, True)
    flow = addresses + packet[begin : begin + 4]
    if protocol == TCP and len(packet) >= begin + TCP_BYTES:
        head = begin + (packet[begin + 12] >> 4) * 4
        carries = len(packet) > head or packet[begin + 13] & FIN_SYN_RST
        return Kind(flow, True) if carries else Kind(b"\0" + flow, False)
    return Kind(flow, True)
