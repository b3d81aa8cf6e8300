"""Tables that the kernel looks numbers up in: the headers are what the script makes of them."""

from __future__ import annotations

from tests.kernels.number_tables import KERNELS, headers


def test_the_headers_are_those_that_the_script_writes() -> None:
    for name, text in headers().items():
        assert (KERNELS / name).read_text(encoding="utf-8") == text
