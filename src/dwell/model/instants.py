"""The instant that never comes, and the latency of what never ends."""

from __future__ import annotations

#: Later than every instant, longer than every latency; sums of two still fit 64 bits.
NEVER_NS = 1 << 62
