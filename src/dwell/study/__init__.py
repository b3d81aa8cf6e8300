"""Studies: many runs, and the statistics over their seeds."""

from typing import Any

import lazy_loader

# A name is imported when it is used; the stub lists ours.
_ours, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> Any:
    """Import a name of ours, or one that another distribution adds."""
    if name in __all__ or name.startswith("__"):
        return _ours(name)
    from dwell.model.entry_points import added_name

    try:
        return added_name(f"study.{name}")
    except AttributeError:
        return _ours(name)
