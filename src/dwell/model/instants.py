"""The instant that never comes, and the latency of what never ends."""

from __future__ import annotations

#: Later than every instant, longer than every latency; the sum with any of them fits 64 bits.
NEVER_NS = 1 << 62
