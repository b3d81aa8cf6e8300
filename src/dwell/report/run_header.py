"""Header of a run's page: cell, scenario, policy, seed, tracking error, from the run's record."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dwell.errors import RunError
from dwell.model import Problem
from dwell.model.disturbed import Disturbed, disturbed
from dwell.record import Run
from dwell.study.drawn_disturbances import disturbances_of


class RunHeader(NamedTuple):
    """Header of a run.

    `kind` is ``simulated`` or ``live``. A dash replaces an unknown scenario, policy, estimator,
    seed or share of shadows. `shadows` has the share of cycles in which each alternative runs as a
    shadow, by placement. `disturbed` has the recorded disturbances of nodes and links, else the
    disturbances sampled again from scenario and seed. `recovered` has the losses of a live run's
    journal.
    """

    problem: Problem
    kind: str
    scenario: str
    policy: str
    estimator: str
    seed: str
    shadows: str
    versions: Mapping[str, str]
    disturbed: tuple[Disturbed, ...]
    tracking: Tracking | None
    recovered: Mapping[str, Any]

    @classmethod
    def of(cls, run: Run) -> RunHeader:
        """Read the header of a run; `RunError` if its problem or disturbances cannot be read."""
        meta = run.meta
        try:
            problem, disturbances = run.problem, disturbances_of(run)
        except RunError as error:
            raise RunError(
                f"this run cannot be reported: its record of the problem is incomplete ({error})"
            ) from None
        return cls(
            problem=problem,
            kind=str(meta.get("kind", "simulated")),
            scenario=str(meta.get("scenario") or "–"),
            policy=str(meta.get("policy") or "–"),
            estimator=str(meta.get("estimator") or "–"),
            seed="–" if meta.get("seed") is None else str(meta["seed"]),
            shadows=", ".join(
                f"{share:g} under {name}"
                for name, share in meta.get("shadow_fractions", {}).items()
                if share
            )
            or "–",
            versions=meta.get("versions", {}),
            disturbed=tuple(disturbed(disturbances, problem.fabric)),
            tracking=Tracking.of(meta),
            recovered=meta.get("recovered", {}),
        )

    @property
    def deadline_ms(self) -> float:
        """Deadline D of the pipeline."""
        return self.problem.pipeline.deadline_ms

    @property
    def policy_name(self) -> str:
        """The policy without its parameters."""
        return re.split(r"[(\s]", self.policy, maxsplit=1)[0] or self.policy

    @property
    def live(self) -> bool:
        """Whether real processes ran."""
        return self.kind == "live"


class Tracking(NamedTuple):
    """Root mean square of the tracking error of a run, by stretches of `step_s` seconds.

    `begin_s` is the time from the first release to the first stretch. `mm` and `px` have the shape
    (stretches,), with NaN for an unknown error.
    """

    begin_s: float
    step_s: float
    mm: NDArray[np.float64]
    px: NDArray[np.float64]

    @classmethod
    def of(cls, meta: Mapping[str, Any]) -> Tracking | None:
        """Read the error from a run's record, if it has one; raise `RunError` if malformed."""
        kept = meta.get("tracking")
        if kept is None:
            return None
        try:
            mm, px = (np.array(kept[name], np.float64) for name in ("rms_mm", "rms_px"))
            tracking = cls(float(kept["begin_s"]), float(kept["step_s"]), mm, px)
        except (KeyError, TypeError, ValueError) as error:
            raise RunError(f"its tracking error cannot be read ({error!r})") from None
        if tracking.step_s <= 0 or mm.shape != px.shape or mm.ndim != 1:
            raise RunError("its tracking error cannot be read: its parts do not fit together")
        return tracking

    def rms(self, begin_s: float, end_s: float) -> tuple[float, float]:
        """Return the root mean squares in mm and px between two instants; NaN if unknown."""
        middle_s = self.begin_s + (np.arange(len(self.mm)) + 0.5) * self.step_s
        inside = (begin_s <= middle_s) & (middle_s < end_s)
        return _rms(self.mm[inside]), _rms(self.px[inside])


def _rms(values: NDArray[np.float64]) -> float:
    known = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(known**2))) if len(known) else math.nan
