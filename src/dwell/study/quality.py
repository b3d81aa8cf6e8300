"""Quality of the actuation: misses in a row, the age of its information, tracking errors.

A cycle *actuates* when it completes, late or not; a lost cycle never does. Its information dates
from its release. The actuator discards a cycle that completes after a newer cycle, so an actuation
never makes the information older.

References
----------
* Bernat, Burns and Llamosí 2001, DOI 10.1109/12.919277; Hamdaoui and Ramanathan 1995, DOI
  10.1109/12.477249: constraints on the misses in any K consecutive cycles.
* Kaul, Yates and Gruteser 2012, DOI 10.1109/INFCOM.2012.6195689: the mean age. Costa, Codreanu and
  Ephremides 2016, DOI 10.1109/TIT.2016.2533395: its peaks.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dwell.model import Servo
from dwell.model.instants import NEVER_NS
from dwell.model.number_arrays import Ints

#: Percentile of the age in `Age.p95_ms`.
PERCENT = 95


class EffectiveCommands(NamedTuple):
    """Commands that took effect, in order; their cycles have the same order.

    Parameters
    ----------
    start_ns : int
        First release of the run. Information dates from it until the first actuation.
    release_ns, at_ns : int64 array, shape (n,)
        Release from which each command's information dates: of its cycle, or of the origin of a
        chain's actuation; and the instant at which the command took effect.
    """

    start_ns: int
    release_ns: Ints
    at_ns: Ints


class Age(NamedTuple):
    """Age of the actuator's information over a stretch of time, ms.

    Parameters
    ----------
    mean_ms, p95_ms, peak_ms : float
        Mean over time, 95th percentile over time, and largest value.
    mean_peak_ms : float
        Mean of the ages just before actuations.
    """

    mean_ms: float
    p95_ms: float
    peak_ms: float
    mean_peak_ms: float


class TrackingError(NamedTuple):
    """Error of the reference loop over a stretch of time; infinite if the loop is unstable.

    Parameters
    ----------
    rms_mm : float
        Root of the mean square.
    iae_mm_s : float
        Integral of the absolute error.
    seconds : float
        Length of the stretch.
    """

    rms_mm: float
    iae_mm_s: float
    seconds: float

    @property
    def mean_mm(self) -> float:
        """Mean absolute error: the IAE per second."""
        return self.iae_mm_s / self.seconds


def actuations(
    release_ns: Ints, latency_ns: Ints, data_age_ns: Ints | None = None
) -> EffectiveCommands:
    """Return the commands that take effect: no newer command completes before or with them.

    Parameters
    ----------
    release_ns, latency_ns : int64 array, shape (n,)
        All cycles from the first, at least one. `NEVER_NS` marks a cycle that never finished.
    data_age_ns : int64 array, shape (n,), optional
        Age of each command's information when it took effect, if it does not date from the release.
    """
    start_ns = int(release_ns[0])
    done = latency_ns < NEVER_NS
    at_ns = (release_ns + latency_ns)[done]
    release_ns = release_ns[done] if data_age_ns is None else at_ns - data_age_ns[done]
    if not (at_ns[:-1] < at_ns[1:]).all():
        newer_ns = np.minimum.accumulate(at_ns[::-1])[::-1]
        fresh = np.append(at_ns[:-1] < newer_ns[1:], True)
        release_ns, at_ns = release_ns[fresh], at_ns[fresh]
    return EffectiveCommands(start_ns, release_ns, at_ns)


def age_of_information(actuated: EffectiveCommands, begin_ns: int, end_ns: int) -> Age:
    """Age at the actuator: t minus the release of the newest command in effect at t.

    The age is a sawtooth that rises by 1 ms per ms and falls at actuations. Its percentile over
    time is exact to the nanosecond.

    Parameters
    ----------
    begin_ns, end_ns : int
        The stretch of time; it begins at or after the first release.
    """
    first = int(np.searchsorted(actuated.at_ns, begin_ns, side="right"))
    last = int(np.searchsorted(actuated.at_ns, end_ns, side="left"))
    before_ns = actuated.release_ns[first - 1] if first else actuated.start_ns
    known_ns = np.concatenate(([before_ns], actuated.release_ns[first:last]))
    since_ns = np.concatenate(([begin_ns], actuated.at_ns[first:last], [end_ns]))
    low, high = since_ns[:-1] - known_ns, since_ns[1:] - known_ns
    span = end_ns - begin_ns
    peaks = high[:-1] if len(high) > 1 else high
    areas = (high - low) * 0.5
    areas *= high + low
    return Age(
        mean_ms=float(np.sum(areas)) / span / 1e6,
        p95_ms=_age_percentile(low, high, PERCENT) / 1e6,
        peak_ms=int(high.max()) / 1e6,
        mean_peak_ms=float(peaks.mean()) / 1e6,
    )


def _age_percentile(low: Ints, high: Ints, percent: int) -> int:
    """Return the age, ns, under which a sawtooth is for a share of the time.

    The time spent under an age a, the sum over teeth of min(max(a, low), high) - low, grows with a
    and is linear between whole nanoseconds: Newton's steps, kept inside the bracket of the answer.

    Parameters
    ----------
    low, high : int64 array, shape (n,)
        Ends of every tooth; each age between them takes as long as any other.
    percent : int
        The share, less than 100.
    """
    wanted = int((high - low).sum()) * percent / 100
    under, over = int(low.min()), int(high.max())
    age = int(high.mean())
    sum_low = int(low.sum())
    reached = np.empty_like(low)
    while over - under > 1:
        np.minimum(np.maximum(low, age, out=reached), high, out=reached)
        # 64 bits may not hold a sum of ages; they hold the difference of two.
        spent = (int(reached.sum()) - sum_low) % 2**64
        if spent < wanted:
            under = age
        else:
            over = age
        rate = np.count_nonzero(low <= age) - np.count_nonzero(high <= age)
        lacking = wanted - spent
        if abs(lacking) <= rate:  # less than a nanosecond away
            return age + round(lacking / rate) if rate else age
        step = age + round(lacking / rate) if rate else under
        age = step if under < step < over else (under + over) // 2
    return over


def track(servo: Servo, actuated: EffectiveCommands, begin_ns: int, end_ns: int) -> TrackingError:
    """Drive the reference loop by the instants of a run.

    Parameters
    ----------
    actuated : EffectiveCommands
        Each command uses the state at its cycle's release, and stays in effect until the next.
    begin_ns, end_ns : int
        The stretch of time whose error counts; the loop runs from the first release.

    Returns
    -------
    TrackingError
        See `dwell.kernels.servo_loop` for the equations and their accuracy.
    """
    from dwell.kernels import servo_loop as kernel

    start_ns = actuated.start_ns
    released_s = (actuated.release_ns - start_ns) / 1e9
    actuated_s = (actuated.at_ns - start_ns) / 1e9
    stretch = (begin_ns - start_ns) / 1e9, (end_ns - start_ns) / 1e9
    status, integrals, _ = kernel.follow(servo, released_s, actuated_s, *stretch)
    seconds = (end_ns - begin_ns) / 1e9
    if status == kernel.DIVERGED:
        return TrackingError(np.inf, np.inf, seconds)
    return TrackingError(float(np.sqrt(integrals[0] / seconds)), float(integrals[1]), seconds)
