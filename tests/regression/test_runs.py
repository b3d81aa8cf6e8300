"""The same seed gives the same cycles, windows and decisions, whatever is combined."""

from __future__ import annotations

import pytest

from tests.regression.runs import DEFAULTS, EXAMPLES, Case, play, read


@pytest.mark.parametrize("example", [*EXAMPLES, *DEFAULTS])
def test_runs_are_those_that_were_written_down(example: str) -> None:
    known, columns = read(example)
    assert len(known) > (3 if example in DEFAULTS else 30)
    changed: dict[Case, dict[str, tuple[str, str]]] = {}
    for case, before in known.items():
        now = play(example, case, columns)
        differs = {name: (before[name], now[name]) for name in before if before[name] != now[name]}
        if differs:
            changed[case] = differs
    assert not changed, f"{len(changed)} of {len(known)} runs, the first ten: " + "\n".join(
        f"{'/'.join(case)}: {differs}" for case, differs in list(changed.items())[:10]
    )
