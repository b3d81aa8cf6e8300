"""EveryPlacement: a search among all placements, which adds candidates to the named ones."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from dwell.errors import Fault
from dwell.model.bounds import Bound
from dwell.model.declaration import declared, key

#: Number of candidates of a cell with a search.
KEEP = Bound(2, 8, whole=True)
#: Keys of a cell file's `candidates` that name no placement.
RESERVED = ("all", "keep")


@declared("candidates")
class EveryPlacement:
    """A search for the cheapest of all placements, made once before a run."""

    keep: int = key(
        "Number of candidates: the named ones, then found placements as `A1`, `A2` and so on.",
        KEEP,
        default=8,
        tier="first",
    )
    is_found: bool = key(
        "`true`: search before a run. `found`: the search is done, as in the record of a run.",
        default=False,
        named="all",
        usual="none",
        tier="first",
    )


def search_faults(
    every: EveryPlacement | None, named: Sequence[str], fallbacks: Sequence[str]
) -> Iterator[Fault]:
    """Yield the faults of reserved names, and of a search with too many named candidates."""
    for name in filter(named.__contains__, RESERVED):
        message = f"the name {name!r} is a key of the search; choose another for the placement"
        yield Fault(f"candidates.{name}", message)
    if every is None:
        return
    for count, what in ((len(fallbacks), "fallbacks"), (len(named), "named candidates")):
        if every.keep < count:
            least = f"it must be at least {count}, the number of {what}"
            yield Fault("candidates.keep", f"{every.keep} is not allowed; {least}")
            return
