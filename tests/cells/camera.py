"""A cell in which shadows hinder one placement: an image holds a link that own messages need."""

from __future__ import annotations

from typing import Any

from dwell.cellfile import from_document
from dwell.cellfile.document_faults import Faults
from dwell.cellfile.yaml_text import read_value
from dwell.model import Problem

#: Under OFF every cycle sends the image over R->E, for 8 ms; under LOC only shadows do, and the
#: small result of `see` may have to wait for it.
CAMERA = """\
dwell: 1
name: camera
period_ms: 20
deadline_ms: 11
window_cycles: 50
nodes:
  R: {tier: robot, cores: 2}
  E: {tier: edge, cores: 4}
links:
  - {from: R, to: E, both_ways: true, delay_ms: 1, rate_mbps: 100}
tasks:
  sense: {on: {R: {exec_ms: 1}}}
  see: {on: {R: {exec_ms: {lognormal: {mean: 6, cv: 0.2}}}, E: {exec_ms: 0.2}}}
  plan: {on: {E: {exec_ms: 1}}}
flows:
  - {from: sense, to: see, bytes: 100000}
  - {from: see, to: plan, bytes: 100}
candidates:
  LOC: {see: R}
  OFF: {see: E}
"""


def camera(**settings: Any) -> Problem:
    """Return the cell with `corrected`, whose shares of shadows follow from their prices."""
    given = {"estimator": "corrected", "shadow_fraction": "auto", **settings}
    document = read_value(CAMERA, Faults(None), "")
    assert isinstance(document, dict)
    return from_document({**document, "controller": given})
