"""Which addresses and ports are this computer's, and which of them are free."""

from __future__ import annotations

import os
import socket

import pytest

from dwell.live.local_addresses import is_here, taken_ports, why_not_listen

#: For documentation (RFC 5737) and for names that are none (RFC 2606).
ELSEWHERE, NOWHERE = "192.0.2.7", "no.such.host.invalid"


@pytest.mark.parametrize("address", ["127.0.0.1", "localhost", "127.3.2.1"])
def test_loopback_is_here(address: str) -> None:
    assert is_here(address)
    assert why_not_listen(address, 0) == ""


def test_why_nobody_can_listen_somewhere_is_said() -> None:
    assert not is_here(ELSEWHERE)
    assert "is no address of this computer" in why_not_listen(ELSEWHERE, 7450)
    assert not is_here(NOWHERE)
    assert "cannot be resolved" in why_not_listen(NOWHERE, 7450)


def test_a_port_that_somebody_has_is_taken_and_by_whom() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        assert f"port {port} of 127.0.0.1 is taken" in why_not_listen("127.0.0.1", port)
        assert taken_ports([port]).endswith(f"(process {os.getpid()})")
    assert taken_ports([port]) == ""
