"""A model-predictive step: the camera's best motion over a horizon, a sparse quadratic program.

The arm holds a commanded velocity, and its ramps are short: so does each step h here,

    p[k+1] = p[k] + h v[k+1],   v[k+1] = v[k] + h a[k]

The tag's future is several scenarios at once, each with a weight: the first accelerations are
common to all, since nobody knows by then which of them it is (Bernardini and Bemporad 2009, DOI
10.1109/CDC.2009.5399917). Each minimises, over its horizon,

    track |p - goal|^2 + pace |v - goal'|^2 + effort |a|^2 + smooth |a[k] - a[k-1]|^2
    + slack (s + s^2 / 4 mm)

within the drives' limits on v and a, and with the tag in view: a cone of the view's smaller angle,
less the tag's own size, as visual predictive control has it (Allibert, Courtial and Chaumette 2010,
DOI 10.1109/TRO.2010.2056590), softened by s so that there always is a solution. The solver is OSQP
(Stellato et al. 2020, DOI 10.1007/s12532-020-00179-2), set up once: matrices never change, and each
step starts at the last one's solution.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import osqp  # type: ignore[import-untyped]
from scipy import sparse

from .scene import Array, Scene

#: Out of view by this much costs half as much again as the first of it would alone.
_SLACK_M = 0.002


@dataclass(frozen=True, slots=True)
class HorizonSettings:
    """What is weighed against what, over how long.

    Parameters
    ----------
    steps : int
    step_s : float
    decays : tuple of float
        Of each scenario: the rate, 1/s, at which the tag loses its velocity; negative, it gains.
    weights : tuple of float
        Of the scenarios; they add up to 1.
    common : int
        Steps whose accelerations all scenarios share.
    track : tuple of float
        By axis, for metres or radians squared.
    pace, effort, smooth : float
        In units of `track`, for (m/s)^2, (m/s^2)^2 and (m/s^2)^2.
    slack : float
        For metres out of view.
    rho : float
        Of the solver: the size of its steps.
    tolerance : float
        Of the solver, absolute and relative.
    iterations : int
        At most; what it has by then is used. With the usual tolerance nearly every step takes all
        of them, and so about as long as any other; each goes on where the last one stopped.
    """

    steps: int = 30
    step_s: float = 0.04
    decays: tuple[float, ...] = (0.0, 0.7, -0.7)
    weights: tuple[float, ...] = (0.5, 0.25, 0.25)
    common: int = 4
    track: tuple[float, ...] = (4e4, 4e4, 4e4, 4e3)
    pace: float = 5e-4
    effort: float = 1e-6
    smooth: float = 1e-7
    slack: float = 2000.0
    rho: float = 3.0
    tolerance: float = 1e-6
    iterations: int = 160


@dataclass(frozen=True, slots=True)
class Motions:
    """A solution; arrays have the shape (scenarios, steps, 4).

    Parameters
    ----------
    positions, velocities : float array
        At the end of each step, and over it.
    accelerations : float array
        From the step before to each step, as if they took all of it.
    out_of_view_m : float array, shape (scenarios, steps)
    iterations : int
        Of the solver; `HorizonSettings.iterations` where it was stopped.
    """

    positions: Array
    velocities: Array
    accelerations: Array
    out_of_view_m: Array
    iterations: int


class Horizon:
    """The quadratic program, kept between steps.

    Parameters
    ----------
    scene : Scene
        Its camera, tag and limits.
    settings : HorizonSettings
    """

    def __init__(self, scene: Scene, settings: HorizonSettings | None = None) -> None:
        self.scene = scene
        self.settings = settings or HorizonSettings()
        # The view's cone: to each of four sides, offset <= slope * depth - radius.
        slope = scene.camera.slope
        self._sides = np.array(
            [[1, 0, slope, 0], [-1, 0, slope, 0], [0, 1, slope, 0], [0, -1, slope, 0]]
        )
        self._radius_m = scene.tag_m / np.sqrt(2)
        quadratic, constraints = self._quadratic(), self._constraints()
        still = np.zeros(4)
        low, high = self._bounds(still, still, self.goals(still, still)[0])
        self._solver = osqp.OSQP()
        # A step size that adapts would factorise anew, at instants of its own choosing.
        self._solver.setup(
            quadratic,
            np.zeros(quadratic.shape[0]),
            constraints,
            low,
            high,
            verbose=False,
            adaptive_rho=False,
            rho=self.settings.rho,
            eps_abs=self.settings.tolerance,
            eps_rel=self.settings.tolerance,
            max_iter=self.settings.iterations,
            check_termination=10,
        )

    def solve(self, position: Array, velocity: Array, target: Array, speed: Array) -> Motions:
        """Plan the camera's motion.

        Parameters
        ----------
        position, velocity : float array, shape (4,)
            Of the camera's axes at the start, the velocity within its limits.
        target, speed : float array, shape (4,)
            Where the camera should be at the start, and how fast that moves.
        """
        # Seen from the target, numbers are small where it matters that they are exact.
        goals, paces = self.goals(np.zeros(4), speed)
        low, high = self._bounds(position - target, velocity, goals)
        self._solver.update(q=self._linear(goals, paces), l=low, u=high)
        result = self._solver.solve(raise_error=False)
        scenarios, steps, _ = goals.shape
        moves = result.x.reshape(scenarios, 13 * steps)
        states = moves[:, : 12 * steps].reshape(scenarios, 3, steps, 4)
        positions, velocities, accelerations = (states[:, part] for part in range(3))
        out_of_view_m = moves[:, 12 * steps :]
        iterations = int(result.info.iter)
        return Motions(target + positions, velocities, accelerations, out_of_view_m, iterations)

    def goals(self, target: Array, speed: Array) -> tuple[Array, Array]:
        """Return where the camera should be at the end of each step, and how fast.

        Returns
        -------
        tuple of float array, shape (scenarios, steps, 4)
        """
        ahead_s = self.settings.step_s * np.arange(1, self.settings.steps + 1)
        decays = np.array(self.settings.decays)[:, None]
        fading = np.exp(-decays * ahead_s)
        # The integral of the fading, with its limit where nothing fades.
        gone_s = np.where(decays == 0, ahead_s, (1 - fading) / np.where(decays == 0, 1, decays))
        return target + gone_s[..., None] * speed, fading[..., None] * speed

    def _quadratic(self) -> sparse.csc_matrix:
        """P of x'Px / 2 + q'x; x is, scenario by scenario, all p, v and a, and then all s."""
        settings = self.settings
        change = self._change()[4:]
        ones = np.ones(4 * settings.steps)
        track, effort = self._track(), np.tile(settings.track, settings.steps)
        smooth = change.T @ sparse.diags(settings.smooth * effort[4:]) @ change
        one = sparse.block_diag(
            [
                sparse.diags(track),
                sparse.diags(settings.pace * track),
                sparse.diags(settings.effort * effort * ones) + smooth,
                sparse.diags(np.full(settings.steps, settings.slack / _SLACK_M / 2)),
            ]
        )
        return sparse.triu(2 * sparse.kron(sparse.diags(settings.weights), one), format="csc")

    def _linear(self, goals: Array, paces: Array) -> Array:
        """Return q."""
        settings, track = self.settings, self._track()
        scenarios, steps, _ = goals.shape
        linear = np.zeros((scenarios, 13 * steps))
        linear[:, : 4 * steps] = -2 * track * goals.reshape(scenarios, -1)
        linear[:, 4 * steps : 8 * steps] = -2 * settings.pace * track * paces.reshape(scenarios, -1)
        linear[:, 12 * steps :] = settings.slack
        weighted: Array = np.array(settings.weights)[:, None] * linear
        return weighted.ravel()

    def _constraints(self) -> sparse.csc_matrix:
        """A of low <= Ax <= high: dynamics, limits and view by scenario, then what is common."""
        settings = self.settings
        steps, h, scenarios = settings.steps, settings.step_s, len(settings.weights)
        every, change = sparse.eye(4 * steps), self._change()
        sides = sparse.kron(sparse.eye(steps), self._sides)
        slack = sparse.kron(sparse.eye(steps), np.ones((4, 1)))
        one = sparse.bmat(
            [
                [change, -h * every, None, None],
                [None, change, -h * every, None],
                [None, every, None, None],
                [None, None, every, None],
                [sides, None, None, -slack],
                [None, None, None, sparse.eye(steps)],
            ]
        )
        first = sparse.eye(4 * settings.common, 13 * steps, k=8 * steps)
        others = sparse.eye(scenarios - 1)
        common = sparse.hstack(
            [sparse.kron(np.ones((scenarios - 1, 1)), first), -sparse.kron(others, first)]
        )
        return sparse.vstack([sparse.kron(sparse.eye(scenarios), one), common], format="csc")

    def _bounds(self, position: Array, velocity: Array, goals: Array) -> tuple[Array, Array]:
        """Return low and high."""
        settings, limits = self.settings, self.scene.limits
        scenarios, steps, _ = goals.shape
        start = np.zeros((2, steps, 4))
        start[:, 0] = position, velocity
        # The camera's goal is the tag less the distance, which the view's depth has to include.
        depth = self.scene.camera.slope * self.scene.distance_m - self._radius_m
        view = goals @ self._sides.T + depth
        most = np.concatenate(
            [np.tile(limits.velocity, steps), np.tile(limits.acceleration, steps)]
        )
        shared = np.zeros(4 * settings.common * (scenarios - 1))
        low, high = [], []
        for seen in view:
            low += [start.ravel(), -most, np.full(4 * steps, -np.inf), np.zeros(steps)]
            high += [start.ravel(), most, seen.ravel(), np.full(steps, np.inf)]
        return np.concatenate([*low, shared]), np.concatenate([*high, shared])

    def _change(self) -> sparse.csr_matrix:
        """Difference of a step's four values from the step's before."""
        size = 4 * self.settings.steps
        return sparse.csr_matrix(sparse.eye(size) - sparse.eye(size, k=-4))

    def _track(self) -> Array:
        """Weights of p by step and axis: the last step stands for what comes after it."""
        weights = np.tile(self.settings.track, self.settings.steps)
        weights[-4:] *= 10
        return weights
