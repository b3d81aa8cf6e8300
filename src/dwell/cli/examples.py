"""The folder with the example cells, which a wheel brings and a checkout has."""

from __future__ import annotations

from pathlib import Path

import dwell
from dwell.errors import ProblemError


def find_examples(given: Path | None) -> Path:
    """Return the folder with the example cells.

    Raises
    ------
    ProblemError
        If it is neither given nor found.
    """
    if given is not None:
        return given
    package = Path(dwell.__file__).parent
    # In a wheel, in a checkout, in the working folder.
    places = (package / "examples", package.parents[1] / "examples", Path("examples"))
    for place in places:
        if (place / "canonical.yaml").is_file():
            return place
    raise ProblemError(
        "the example cells are not installed with the package; run this in a checkout of the "
        "repository, or name their folder with --examples"
    )
