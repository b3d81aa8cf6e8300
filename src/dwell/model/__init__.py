"""The frozen domain objects: pipeline, fabric, candidates, metrics and decisions."""

from dwell.model.chain import Chain
from dwell.model.controller_settings import ControllerSettings
from dwell.model.evolve import evolve
from dwell.model.fabric import Bursts, Fabric, Link, Node, Quota
from dwell.model.frozen import FrozenDict
from dwell.model.live import Endpoint, Host, LiveSettings
from dwell.model.objective import AIM, Caps, MissCap, Objective, Targets, Tier, Weights
from dwell.model.pipeline import Execution, Flow, Pipeline, Task
from dwell.model.placement import Placement, Replicas
from dwell.model.problem import Problem
from dwell.model.process import (
    AR1,
    Constant,
    Exponential,
    Gamma,
    LogNormal,
    Normal,
    Process,
    Trace,
    TraceTable,
    Uniform,
)
from dwell.model.qos import REASONS, Decision, QoS, Reason
from dwell.model.scenario import (
    Disturbance,
    Episodes,
    LinkDisturbance,
    NodeDisturbance,
    Scenario,
)
from dwell.model.servo import MovingTarget, Servo

__all__ = [
    "AIM",
    "AR1",
    "REASONS",
    "Bursts",
    "Caps",
    "Chain",
    "Constant",
    "ControllerSettings",
    "Decision",
    "Disturbance",
    "Endpoint",
    "Episodes",
    "Execution",
    "Exponential",
    "Fabric",
    "Flow",
    "FrozenDict",
    "Gamma",
    "Host",
    "Link",
    "LinkDisturbance",
    "LiveSettings",
    "LogNormal",
    "MissCap",
    "MovingTarget",
    "Node",
    "NodeDisturbance",
    "Normal",
    "Objective",
    "Pipeline",
    "Placement",
    "Problem",
    "Process",
    "QoS",
    "Quota",
    "Reason",
    "Replicas",
    "Scenario",
    "Servo",
    "Targets",
    "Task",
    "Tier",
    "Trace",
    "TraceTable",
    "Uniform",
    "Weights",
    "evolve",
]
