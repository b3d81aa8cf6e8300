"""Progress of long work."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

#: A function that receives the finished and the total amount of work.
Progress: TypeAlias = Callable[[int, int], None]
