"""The columns of a table as arrays, which work without Polars."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, TypeAlias, cast

from dwell.model.instants import NEVER_NS

if TYPE_CHECKING:
    import numpy as np
    import polars as pl
    from numpy.typing import NDArray

#: Values of a column (an array, a sequence, or `Names`), or a function that makes them.
Made: TypeAlias = "object | Callable[[], object]"


@dataclass(frozen=True, slots=True, eq=False)
class Names:
    """Names, one per row.

    Parameters
    ----------
    places : integer array, shape (n,)
        Index of each name in `known`.
    known : tuple of str
        All possible names.
    """

    places: NDArray[np.integer]
    known: tuple[str, ...]

    def __repr__(self) -> str:
        return f"<Names: {len(self.places)} of {', '.join(self.known)}>"

    @classmethod
    def of(cls, names: Sequence[str], known: Sequence[str]) -> Names:
        """Return names as indices into the known names."""
        import numpy as np

        place = {name: i for i, name in enumerate(known)}
        places = np.fromiter((place[name] for name in names), np.int32, len(names))
        return cls(places, tuple(known))

    def __getitem__(self, rows: slice | NDArray[np.bool_]) -> Names:
        return Names(self.places[rows], self.known)

    def equal(self, name: str) -> NDArray[np.bool_]:
        """Return whether each row has the given name."""
        place = self.known.index(name) if name in self.known else -1
        equal: NDArray[np.bool_] = self.places == place
        return equal

    def to_list(self) -> list[str]:
        """Return the name of each row."""
        return [self.known[place] for place in self.places.tolist()]


class TableArrays:
    """Columns of a table by name, each made at the first access.

    A missing value is NaN in a column of floats and `NEVER_NS` in a column of integers.

    Parameters
    ----------
    columns : mapping of str to array, sequence or `Names`, or to a function that makes one
    """

    def __init__(self, columns: Mapping[str, Made]) -> None:
        self._columns = dict(columns)

    def __repr__(self) -> str:
        return f"<TableArrays: {', '.join(self)}>"

    def __iter__(self) -> Iterator[str]:
        return iter(self._columns)

    def __getitem__(self, name: str) -> NDArray[Any]:
        """Return a column of numbers or truth values."""
        import numpy as np

        array = np.asarray(self._made(name))
        # Numbers with None among them become floats with NaN.
        return array.astype(np.float64) if array.dtype == np.object_ else array

    def names(self, name: str) -> Names:
        """Return a column of names."""
        return cast("Names", self._made(name))

    def columns(self) -> dict[str, object]:
        """Return all columns as they were made."""
        return {name: self._made(name) for name in self._columns}

    def _made(self, name: str) -> object:
        column = self._columns[name]
        if callable(column):
            column = self._columns[name] = column()
        return column


def arrays_of(frame: pl.DataFrame) -> TableArrays:
    """Return the columns of a data frame."""
    return TableArrays({name: partial(_column, frame[name]) for name in frame.columns})


def _column(series: pl.Series) -> object:
    import polars as pl

    if series.dtype == pl.Int64 and series.null_count():
        series = series.set(series.is_null(), NEVER_NS)
    if series.dtype == pl.String:
        series = series.cast(pl.Enum(series.unique().drop_nulls().sort()))
    if isinstance(series.dtype, pl.Enum):
        return Names(series.to_physical().to_numpy(), tuple(series.dtype.categories))
    return series.to_numpy()
