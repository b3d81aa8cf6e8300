"""Display of results: a summary on a screen, and a picture in a notebook.

Both are made by `dwell.report`, which is imported when something is shown.
"""

from __future__ import annotations


class Displayed:
    """Has a summary, and in a notebook a picture with its numbers."""

    __slots__ = ()

    def summary(self) -> str:
        """Return what it comes to as text: 24 lines of 80 columns at most."""
        from dwell.report.answer import summary_of

        return summary_of(self)

    def _repr_html_(self) -> str:
        from dwell.report.answer import html_of

        return html_of(self)
