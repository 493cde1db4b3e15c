"""Search by gradient: the acquisition is a differentiable function of the pose."""

from typing import ClassVar

import equinox as eqx
import optimistix as optx
from jaxtyping import PRNGKeyArray

from jaxnbv.acquisition import Acquisition
from jaxnbv.checks import check_fields, checked, require
from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.pose import Pose
from jaxnbv.search.ascent import Ascent
from jaxnbv.search.base import Search
from jaxnbv.search.candidates import Candidates, NumberedCandidates, as_candidates
from jaxnbv.search.pose_space import FreePoses, PoseSpace, SpherePoses
from jaxnbv.search.problem import Problem
from jaxnbv.search.proposal import Proposal


class GradientSearch(Search):
    """Multi-start gradient ascent over 2-DOF or 6-DOF poses.

    - `dof`: 2 for `SpherePoses()`, 6 for `FreePoses()`; or give a `space` of your own, `ConstrainedPoses()` say.
    - `num_candidates`: poses, spread evenly over the space and turned at random, that are evaluated first; the ascent
      starts from the best `num_starts` of them. With as many candidates as starts, every candidate is a start.
    - `candidates`: in their place, poses of your own; `turned`: whether the key turns them, if they can be turned.
    - `num_starts`, `iterations`, `learning_rate`, `solver`: see `Ascent`.

    Differentiation keeps what the acquisition computed for all starts and samples, with PointNet++ several gigabytes;
    fewer starts need less.

    Starts, steps and rate are the paper's. It starts from six views drawn at random, evaluates no others first, and
    returns the best final value; `num_candidates=6` comes nearest to that.

    **Raises:** `ValueError` for another `dof`, both `dof` and `space`, fewer candidates than starts, no starts or
    iterations, or a learning rate that is not positive; within a `Planner`, also for an acquisition that JAX cannot
    differentiate, and a camera that the space is not for.
    """

    ascent: Ascent
    candidates: Candidates
    turned: bool = eqx.field(static=True)
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
        turned: bool = True,
    ):
        self.ascent = Ascent(_pose_space(dof, space), num_starts, iterations, learning_rate, solver)
        of_space = SpaceCandidates(space=self.ascent.space, num_poses=num_candidates)
        self.candidates = of_space if candidates is None else as_candidates(candidates)
        self.turned = turned
        require(
            self.candidates.count >= num_starts,
            f"the search has {self.candidates.count} candidates for {num_starts} starts: give it as many at least",
        )

    def check(self, acquisition: Acquisition, camera: Camera, capacity: int) -> None:
        """See `Ascent.check`."""
        self.ascent.check(acquisition, camera, capacity)

    def propose(self, problem: Problem, key: PRNGKeyArray) -> Proposal:
        """The best pose that was seen, candidates included; the key turns the candidates, if they are to be turned."""
        return self.ascent.climb(problem, self.candidates.poses(key if self.turned else None))


class HybridSearch(GradientSearch):
    """The discrete search, then gradient ascent from its best few candidates: a `GradientSearch` with other defaults.

    Steps are fewer and longer. On the sphere the candidates are those of a `DiscreteSearch` with as many, so the value
    found is never below its.

    **Raises:** `ValueError` as `GradientSearch` does.
    """

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
        turned: bool = False,
    ):
        super().__init__(dof, space, num_starts, iterations, learning_rate, num_candidates, solver, candidates, turned)


class SpaceCandidates(NumberedCandidates):
    """Poses of a pose space, spread evenly over it.

    **Raises:** `ValueError` for a number below one.
    """

    space: PoseSpace
    num_poses: int = eqx.field(static=True)

    def __check_init__(self):
        check_fields(self)
        require(self.num_poses >= 1, f"the search has {self.num_poses} candidates; it needs at least one")

    def poses(self, key: PRNGKeyArray | None = None) -> Pose:
        return self.space.candidates(self.num_poses, key)


def _pose_space(dof: int | None, space: PoseSpace | None) -> PoseSpace:
    """The space that is meant by the number of degrees of freedom, by default 2, or that was given."""
    if space is not None:
        require(dof is None, f"both dof={dof} and space={space} were given: give one of them")
        return space
    require(dof in (None, 2, 6), f"dof is {dof}; it must be 2 or 6 (or give a space)")
    return FreePoses() if dof == 6 else SpherePoses()
