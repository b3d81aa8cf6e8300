"""Processes of the machine, as tests look at them."""

from __future__ import annotations

import psutil


def lives(pid: int) -> bool:
    """Whether a process runs; what has ended may wait for its parent, or for init."""
    try:
        return psutil.Process(pid).status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False
