"""Gradient searches, which maximise the acquisition by gradient ascent in the pose."""

import dataclasses
import math
from functools import partial
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
import optimistix as optx
from jaxtyping import Array, Float, PRNGKeyArray

from jaxnbv.acquisition import Acquisition
from jaxnbv.checks import check_fields, checked, require
from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.pose import Pose
from jaxnbv.search.base import Search, best_unvisited, first_best, standard_error
from jaxnbv.search.candidates import Candidates, as_candidates
from jaxnbv.search.pose_space import FreePoses, PoseSpace, SpherePoses
from jaxnbv.search.problem import Problem
from jaxnbv.search.proposal import Proposal, Trajectories
from jaxnbv.search.traceable import check_traceable

# Penalty for each scene unit by which a camera is too close to an obstacle, in ranges of the candidates' values.
_PENALTY = 10.0


class GradientSearch(Search):
    """Gradient ascent by Optimistix over 2-DOF or 6-DOF poses, from several starts in one batch.

    - `dof`: 2 for `SpherePoses()`, 6 for `FreePoses()`.
    - `space`: pose space to use in place of `dof`, for example `ConstrainedPoses()`.
    - `num_starts`: number of starts, the candidates with the highest values.
    - `iterations`: number of steps from each start. Each step evaluates the acquisition and its gradient once.
    - `learning_rate`: learning rate of Adam, in the units of the parameters (roughly radians or scene units).
    - `num_candidates`: number of candidates to evaluate before the ascent. They are spread evenly over the space, and
      all rotated by the same random rotation. If the number equals `num_starts`, every candidate is a start.
    - `solver`: Optimistix minimiser to use in place of Adam, for example `optimistix.BFGS(rtol=1e-4, atol=1e-4)`. The
      objective is scaled so that the candidates' values span a range of 1.
    - `candidates`: your own candidates to use in place of `num_candidates`. They are not rotated.

    The default numbers of starts and steps and the default learning rate are the paper's. The paper starts from six
    random views without evaluating other candidates first, and returns the best final value. `num_candidates=6` is
    closest to the paper. Differentiation stores intermediate results for all starts and samples. With PointNet++ these
    take gigabytes.

    **Raises:** `ValueError` for a `dof` other than 2 or 6, for both `dof` and `space`, fewer candidates than starts, no
    starts or iterations, or a learning rate that is not positive. A `Planner` with this search raises `ValueError` for
    an acquisition that JAX cannot differentiate, or a camera that `PoseSpace.check_camera` refuses.
    """

    space: PoseSpace
    num_starts: int = eqx.field(static=True)
    iterations: int = eqx.field(static=True)
    learning_rate: float = eqx.field(static=True)
    num_candidates: int = eqx.field(static=True)
    solver: optx.AbstractMinimiser | None
    candidates: Candidates | None
    rotates_candidates: ClassVar[bool] = True
    uses_samples: ClassVar[bool] = True

    @checked
    def __init__(
        self,
        dof: int | None = None,
        space: PoseSpace | None = None,
        num_starts: int = 6,
        iterations: int = 20,
        learning_rate: float = 0.01,
        num_candidates: int = 100,
        solver: optx.AbstractMinimiser | None = None,
        candidates: Candidates | Pose | None = None,
    ):
        require(dof is None or space is None, f"both dof={dof} and space={space} were given: give one of them")
        require(dof in (None, 2, 6), f"dof is {dof}; it must be 2 or 6 (or give a space)")
        self.space = space or (FreePoses() if dof == 6 else SpherePoses())
        self.num_starts, self.iterations, self.learning_rate = num_starts, iterations, learning_rate
        self.solver = solver
        self.candidates = None if candidates is None else as_candidates(candidates)
        self.num_candidates = num_candidates if self.candidates is None else self.candidates.count

    def __check_init__(self):
        check_fields(self)
        for name in ("num_starts", "iterations"):
            value = getattr(self, name)
            require(value >= 1, f"{name} is {value}; it must be at least 1")
        require(
            0 < self.learning_rate < math.inf,
            f"the learning rate is {self.learning_rate}; it must be positive and finite, such as 0.01",
        )
        require(
            self.num_candidates >= self.num_starts,
            f"the search has {self.num_candidates} candidates for {self.num_starts} starts: give at least as many",
        )

    @property
    def minimiser(self) -> optx.AbstractMinimiser:
        """The minimiser: `solver` if given, otherwise Adam."""
        if self.solver is not None:
            return self.solver
        # Zero tolerances are never met, so all iterations run.
        return optx.OptaxMinimiser(optax.adam(self.learning_rate), rtol=0.0, atol=0.0)

    def poses_around(self) -> Pose:
        return super().poses_around() if self.candidates is None else self.candidates.poses()

    def upper_half(self) -> "GradientSearch":
        if self.candidates is None:
            return self
        return eqx.tree_at(lambda search: search.candidates, self, self.candidates.upper_half())

    def check(self, acquisition: Acquisition, camera: Camera, capacity: int) -> None:
        self.space.check_camera(camera)
        check_traceable(acquisition, capacity, camera, differentiable=True)

    def propose(self, problem: Problem, key: PRNGKeyArray) -> Proposal:
        """Propose the best pose of all trajectories and candidates. The key rotates the space's candidates."""
        if self.candidates is None:
            candidates = self.space.candidates(self.num_candidates, key if self.rotates_candidates else None)
        else:
            candidates = self.candidates.poses()
        scores = problem.scores(candidates)
        values = jnp.mean(scores, axis=0)
        order = jnp.argsort(jnp.where(problem.is_excluded(candidates), -jnp.inf, values), descending=True)
        # Solvers with a line search expect differences of order one.
        value_range = jnp.max(values) - jnp.min(values)
        value_range = jnp.where(value_range > 0, value_range, 1.0)
        starts = candidates[order[: self.num_starts]]
        trajectories, errors = jax.vmap(partial(self._walk, problem, value_range))(starts)
        best_candidate = best_unvisited(problem, candidates, values, tie=0.0, scores=scores)
        best_step = best_unvisited(problem, *trajectories.flat, tie=0.0)
        # A comparison with NaN is False, so `is_better` is True and NaN reaches the planner, which reports it.
        is_better = ~(best_step.value <= best_candidate.value)
        # `flat` swaps the axes of the trajectories, so transpose their errors too.
        best_step = dataclasses.replace(
            best_step, standard_error=errors.T.reshape(-1)[first_best(best_step.values, tie=0.0)]
        )
        options = [(p.pose, p.value, p.standard_error) for p in (best_step, best_candidate)]
        pose, value, error = jax.tree.map(partial(jnp.where, is_better), *options)
        return dataclasses.replace(
            best_candidate, pose=pose, value=value, standard_error=error, trajectories=trajectories
        )

    def _walk(
        self, problem: Problem, value_range: Float[Array, ""], start: Pose
    ) -> tuple[Trajectories, Float[Array, " steps"]]:
        """Run the solver from a start, and return the trajectory and the standard errors of its values.

        The trajectory contains every evaluated pose or, for a solver with a line search, every accepted pose.
        """
        solver = self.minimiser

        def loss(parameters, _):
            pose = self.space.retract(start, parameters)
            scores = problem.scores(pose[None])
            value, error = jnp.mean(scores, axis=0)[0], standard_error(jax.lax.stop_gradient(scores))[0]
            # If a gradient was NaN, the parameters are NaN, but the pose may still be finite.
            value = jnp.where(jnp.isfinite(parameters).all(), value, jnp.nan)
            # Poses that violate the clearance are never proposed. The penalty drives the solver away from such poses.
            return _PENALTY * problem.violation(pose[None])[0] - value / value_range, (pose, value, error)

        parameters = jnp.zeros(self.space.num_parameters, start.position.dtype)
        struct, aux_struct = jax.eval_shape(loss, parameters, None)
        state = solver.init(loss, parameters, None, {}, struct, aux_struct, frozenset())
        state, static = eqx.partition(state, eqx.is_array)

        def step(carry, _):
            parameters, state = carry
            solver_state = eqx.combine(state, static)
            is_done, _ = solver.terminate(loss, parameters, None, {}, solver_state, frozenset())
            next_parameters, solver_state, output = solver.step(loss, parameters, None, {}, solver_state, frozenset())
            next_carry = next_parameters, eqx.filter(solver_state, eqx.is_array)
            return jax.tree.map(partial(jnp.where, is_done), carry, next_carry), output

        # The additional step evaluates the pose after the last iteration.
        _, (poses, values, errors) = jax.lax.scan(step, (parameters, state), length=self.iterations + 1)
        return Trajectories(poses, values), errors


class HybridSearch(GradientSearch):
    """Discrete search, followed by gradient ascent from the best candidates.

    This is a `GradientSearch` whose defaults are fewer starts and fewer, longer steps. Its candidates are not rotated.
    By default they are the candidates of `DiscreteSearch()`, so the value is at least the best value of that search.
    """

    rotates_candidates: ClassVar[bool] = False

    def __init__(
        self,
        dof: int | None = None,
        space: PoseSpace | None = None,
        num_starts: int = 3,
        iterations: int = 6,
        learning_rate: float = 0.02,
        num_candidates: int = 120,
        solver: optx.AbstractMinimiser | None = None,
        candidates: Candidates | Pose | None = None,
    ):
        super().__init__(dof, space, num_starts, iterations, learning_rate, num_candidates, solver, candidates)
