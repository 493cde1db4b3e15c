"""Multi-start gradient ascent of the acquisition, through Optimistix."""

import dataclasses
import math
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
import optimistix as optx
from jaxtyping import Array, Float

from jaxnbv.acquisition import Acquisition, check_differentiable
from jaxnbv.checks import check_fields, require
from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.pose import Pose
from jaxnbv.search.base import best_unvisited
from jaxnbv.search.pose_space import PoseSpace
from jaxnbv.search.problem import Problem
from jaxnbv.search.proposal import Proposal, Trajectories

# In ranges of the candidates' values, for each scene unit.
_PENALTY = 10.0


class Ascent(eqx.Module):
    """Gradient ascent of the acquisition from the best of some candidates, all starts at once.

    - `space`: where poses may go.
    - `num_starts`: how many of the candidates are started from.
    - `iterations`: steps of the solver from each; each evaluates the acquisition and its gradient once.
    - `learning_rate`: Adam's, in the units of the space's parameters: radians or scene units, about. Another solver
      does not use it.
    - `solver`: a minimiser of Optimistix in place of Adam, such as `optimistix.BFGS(rtol=1e-4, atol=1e-4)`; the
      objective that it is given is of order 1.

    **Raises:** `ValueError` for a number of starts or iterations below one, or a learning rate that is not positive.
    """

    space: PoseSpace
    num_starts: int = eqx.field(static=True)
    iterations: int = eqx.field(static=True)
    learning_rate: float = eqx.field(static=True)
    solver: optx.AbstractMinimiser | None = None

    def __check_init__(self):
        check_fields(self)
        for name in ("num_starts", "iterations"):
            value = getattr(self, name)
            require(value >= 1, f"{name} is {value}; it must be at least 1")
        require(
            0 < self.learning_rate < math.inf,
            f"the learning rate is {self.learning_rate}; it must be positive and finite, such as 0.01",
        )

    @property
    def minimiser(self) -> optx.AbstractMinimiser:
        if self.solver is not None:
            return self.solver
        # No tolerance is ever met: as many steps as were asked for.
        return optx.OptaxMinimiser(optax.adam(self.learning_rate), rtol=0.0, atol=0.0)

    def check(self, acquisition: Acquisition, camera: Camera, capacity: int) -> None:
        """Raise `ValueError` if the acquisition has no gradient, or the space makes no sense for the camera."""
        self.space.check_camera(camera)
        check_differentiable(acquisition, capacity, camera)

    def climb(self, problem: Problem, candidates: Pose) -> Proposal:
        """The best pose on the trajectories from the best candidates, or the best candidate if none is better."""
        scores = problem.scores(candidates)
        values = jnp.mean(scores, axis=0)
        order = jnp.argsort(jnp.where(problem.is_closed(candidates), -jnp.inf, values), descending=True)
        # Solvers that search along a line expect differences of order one.
        scale = jnp.max(values) - jnp.min(values)
        scale = jnp.where(scale > 0, scale, 1.0)
        trajectories = jax.vmap(partial(self._walk, problem, scale))(candidates[order[: self.num_starts]])
        found = best_unvisited(problem, candidates, values, tie=0.0, scores=scores)
        passed = best_unvisited(problem, *trajectories.flat, tie=0.0)
        # Whatever is not a number comes through, so that the planner can say so.
        better = ~(passed.value <= found.value)
        pose, value = jax.tree.map(partial(jnp.where, better), *[(p.pose, p.value) for p in (passed, found)])
        return dataclasses.replace(found, pose=pose, value=value, trajectories=trajectories)

    def _walk(self, problem: Problem, scale: Float[Array, ""], start: Pose) -> Trajectories:
        """Where the solver stood: every pose it evaluated or, of one that searches along a line, those it accepted."""
        solver = self.minimiser

        def loss(parameters, _):
            pose = self.space.retract(start, parameters)
            value = problem.values(pose[None])[0]
            # A pose may hide that the gradient which led to it was not a number.
            value = jnp.where(jnp.isfinite(parameters).all(), value, jnp.nan)
            # A pose where no camera may stand is never chosen; the penalty leads out of there.
            return _PENALTY * problem.violation(pose[None])[0] - value / scale, (pose, value)

        parameters = jnp.zeros(self.space.num_parameters, start.position.dtype)
        struct, aux_struct = jax.eval_shape(loss, parameters, None)
        state = solver.init(loss, parameters, None, {}, struct, aux_struct, frozenset())
        state, rest = eqx.partition(state, eqx.is_array)

        def step(carry, _):
            parameters, state = carry
            whole = eqx.combine(state, rest)
            done, _ = solver.terminate(loss, parameters, None, {}, whole, frozenset())
            moved, whole, seen = solver.step(loss, parameters, None, {}, whole, frozenset())
            after = moved, eqx.filter(whole, eqx.is_array)
            return jax.tree.map(partial(jnp.where, done), carry, after), seen

        # One step more, for the value of the pose that the last one led to.
        _, (poses, values) = jax.lax.scan(step, (parameters, state), length=self.iterations + 1)
        return Trajectories(poses, values)
