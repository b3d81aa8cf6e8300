"""The quadratic program against a dense solution by another method, and against its constraints."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import nnls

from examples.visual_servoing.servoing.horizon import Horizon, HorizonSettings
from examples.visual_servoing.servoing.scene import Array, Scene

SCENE = Scene()
SMALL = HorizonSettings(
    steps=4, decays=(0.0, 4.0), weights=(0.7, 0.3), common=2, tolerance=1e-7, iterations=50_000
)
NOWHERE = np.zeros(4)


def rolled(
    flat: Array, position: Array, velocity: Array, target: Array, speed: Array
) -> tuple[Array, Array]:
    """Play accelerations: weighted residuals whose squares are the cost, and margins to limits."""
    moves = flat.reshape(2, SMALL.steps, 4)
    h, limits, track = SMALL.step_s, SCENE.limits, np.array(SMALL.track)
    slope, radius = SCENE.camera.slope, SCENE.tag_m / np.sqrt(2)
    residuals: list[Array] = []
    margins: list[Array] = []
    for s, (weight, decay) in enumerate(zip(SMALL.weights, SMALL.decays, strict=True)):
        p, v, before = position, velocity, None
        for k in range(SMALL.steps):
            a = moves[0 if k < SMALL.common else s, k]
            v = v + h * a
            p = p + h * v
            ahead = (k + 1) * h
            gone = ahead if decay == 0 else (1 - np.exp(-decay * ahead)) / decay
            goal, pace = target + gone * speed, speed * np.exp(-decay * ahead)
            root = np.sqrt(weight * track)
            last = np.sqrt(10 if k == SMALL.steps - 1 else 1)
            residuals += [last * root * (p - goal), last * root * np.sqrt(SMALL.pace) * (v - pace)]
            residuals += [root * np.sqrt(SMALL.effort) * a]
            if before is not None:
                residuals += [root * np.sqrt(SMALL.smooth) * (a - before)]
            before = a
            side = slope * (goal[2] + SCENE.distance_m - p[2]) - radius
            off = (p - goal)[:2]
            most = np.array(limits.velocity)
            margins += [most - v, most + v, side - off, side + off]
    return np.concatenate(residuals), np.concatenate(margins)


def dense(*start: Array) -> Array:
    """Solve `SMALL` over accelerations alone, as least squares with linear inequalities.

    By Lawson and Hanson, Solving Least Squares Problems, chapter 23: an orthogonal change of
    variables leaves the point nearest to 0 of a polyhedron, which non-negative least squares finds.
    """
    most = np.tile(SCENE.limits.acceleration, 2 * SMALL.steps)
    free = np.ones((2, SMALL.steps, 4), bool)
    free[1, : SMALL.common] = False
    units = np.diag(most)[free.ravel()]
    # Both are affine in the accelerations, so that playing unit vectors gives their matrices.
    residual, margin = rolled(np.zeros(most.size), *start)
    played = [rolled(unit, *start) for unit in units]
    cost = np.column_stack([column - residual for column, _ in played])
    limit = np.column_stack([column - margin for _, column in played])
    limit = np.vstack([limit, np.eye(len(units)), -np.eye(len(units))])
    margin = np.append(margin, np.ones(2 * len(units)))
    q, r = np.linalg.qr(cost)
    turned = limit @ np.linalg.inv(r)
    needed = turned @ (q.T @ residual) - margin
    stacked = np.vstack([turned.T, needed])
    wanted = np.append(np.zeros(len(units)), 1.0)
    rest = stacked @ nnls(stacked, wanted)[0] - wanted
    assert -rest[-1] > 1e-9, "no accelerations keep to the limits"
    x = np.linalg.solve(r, -rest[:-1] / rest[-1] - q.T @ residual)
    moves: Array = (units.T @ x).reshape(2, SMALL.steps, 4)
    moves[1, : SMALL.common] = moves[0, : SMALL.common]
    return moves


@pytest.mark.parametrize(
    ("off", "velocity", "speed"),
    [
        ([0.004, -0.002, 0.003, 0.02], [0.0, 0.1, 0.0, 0.0], [0.2, 0.1, -0.1, 0.3]),
        ([0.05, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0]),
        ([0.06, 0.06, 0.05, 0.4], [0.7, 0.75, 0.4, 2.9], [0.3, 0.3, 0.1, 1.0]),
    ],
    ids=["nothing-binds", "acceleration-binds", "velocity-binds"],
)
def test_a_small_case_has_the_dense_solution(
    off: list[float], velocity: list[float], speed: list[float]
) -> None:
    target = np.array([0.01, -0.02, -0.3, 0.1])
    start = (target - off, np.array(velocity), target, np.array(speed))
    motions = Horizon(SCENE, SMALL).solve(*start)
    assert motions.iterations < SMALL.iterations
    assert motions.out_of_view_m == pytest.approx(0, abs=1e-5)
    moves = dense(*start)
    # To a thousandth of what the drives can.
    worst = np.abs(motions.accelerations - moves) / SCENE.limits.acceleration
    assert worst.max() < 1e-3


LONG = HorizonSettings(steps=12, iterations=4000)


@pytest.mark.parametrize("seed", range(8))
def test_every_plan_keeps_to_the_limits(seed: int) -> None:
    random = np.random.default_rng(seed)
    most = np.array(SCENE.limits.velocity)
    velocity, speed = random.uniform(-most, most), 0.3 * random.uniform(-most, most)
    position = np.array(SCENE.home)
    target = position + random.uniform(-1, 1, 4) * [0.15, 0.15, 0.15, 1.0]
    motions = Horizon(SCENE, LONG).solve(position, velocity, target, speed)
    limits, h = SCENE.limits, LONG.step_s
    # Nearly: the solver stops somewhere, and the arm's drives have the last word.
    assert (np.abs(motions.velocities) < 1.005 * np.array(limits.velocity)).all()
    assert (np.abs(motions.accelerations) < 1.005 * np.array(limits.acceleration)).all()
    common = motions.accelerations[:, : LONG.common]
    assert np.abs(common - common[0]).max() < 2e-3
    before = np.concatenate([np.tile(velocity, (3, 1, 1)), motions.velocities[:, :-1]], axis=1)
    after = before + h * motions.accelerations
    assert np.abs(after - motions.velocities).max() < 2e-3


def test_a_tag_out_of_view_brings_the_camera_back_faster_than_its_place_alone() -> None:
    target = np.array([0.12, 0.0, -0.35, 0.0])
    views = []
    for slack in (1e-6, HorizonSettings().slack):
        wide = Horizon(SCENE, HorizonSettings(slack=slack, track=(10.0, 10.0, 10.0, 1.0)))
        motions = wide.solve(np.array([0, 0, -0.35, 0.0]), NOWHERE, target, NOWHERE)
        offset = np.abs(motions.positions[0, :, 0] - target[0])
        depth = target[2] + SCENE.distance_m - motions.positions[0, :, 2]
        views.append(float((offset - SCENE.camera.slope * depth).sum()))
    assert views[1] < views[0]


def test_a_step_goes_on_where_the_last_one_stopped() -> None:
    start = (np.array(SCENE.home), NOWHERE, np.array(SCENE.home) + 0.02, NOWHERE)
    exact = Horizon(SCENE, HorizonSettings(iterations=4000)).solve(*start).positions
    stopped = Horizon(SCENE, HorizonSettings(iterations=40))
    off = [float(np.abs(stopped.solve(*start).positions - exact).max()) for _ in range(3)]
    assert off[2] < 0.8 * off[0]
