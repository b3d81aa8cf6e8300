"""Parameters of a policy, as the record of a run stores them."""

from __future__ import annotations

import inspect
import math

from dwell.model.document import objective_document
from dwell.model.objective import Objective
from dwell.policies.protocol import Proposer


def parameters_of(policy: object) -> dict[str, object]:
    """Return the constructor arguments that a policy stores under their own names.

    The values are ready for JSON: numbers, names and None, an infinite number as ``"inf"``, the
    objective as in a cell file, and another policy as its class and parameters. Other values, such
    as candidates, are left out.
    """
    kept: dict[str, object] = {}
    for name in inspect.signature(type(policy)).parameters:
        value = getattr(policy, name, inspect.Parameter.empty)
        if isinstance(value, Objective):
            kept[name] = objective_document(value)
        elif isinstance(value, float) and not math.isfinite(value):
            kept[name] = str(value)
        elif isinstance(value, Proposer):
            kept[name] = {"policy": type(value).__name__, **parameters_of(value)}
        elif value is None or isinstance(value, bool | int | float | str):
            kept[name] = value
    return kept
