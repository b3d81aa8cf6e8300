"""Progress of long work."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

#: Told how much is done, and of how much.
Progress: TypeAlias = Callable[[int, int], None]
