"""Results of a search: proposals and the trajectories of gradient searches."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxnbv.checks import require
from jaxnbv.geometry.frame import Frame
from jaxnbv.geometry.pose import Pose


class Trajectories(eqx.Module):
    """Poses and values of a gradient search at each step, for each of its starts.

    - `poses`: a batch with the axes of `values`; there are `iterations` + 1 steps.
    """

    poses: Pose
    values: Float[Array, "*starts steps"]

    @property
    def flat(self) -> tuple[Pose, Float[Array, " looks"]]:
        """All poses and values along one axis: all starts, then all first steps, and so on."""
        poses, values = jax.tree.map(lambda rows: jnp.swapaxes(rows, 0, 1), (self.poses, self.values))
        return jax.tree.map(lambda rows: rows.reshape(-1, *rows.shape[2:]), (poses, values))


class Proposal(eqx.Module):
    """A search's result: the next pose, and the values of all poses that were evaluated.

    - `pose`, `value`: the proposed pose and its value, in the units of the search's quantity.
    - `candidates`, `values`: all candidates and their values; -inf for an excluded one.
    - `trajectories`: trajectories of a gradient search, from the best candidates; None for other searches.
    - `standard_errors`: standard errors of the values, as means over the samples on which a candidate was scored.
    - `difference_errors`: standard errors of the differences to the best value. They are smaller, since all poses are
      scored on the same samples. None for a search that does not score all candidates on all samples.
    - `standard_error`: standard error of `value`, a mean over posterior samples. NaN for one sample; None for a search
      without scores.
    - `value_at_visited`: mean value expected at visited poses, see `Problem.value_at_visited`; None unless the
      acquisition `gains_once`.
    """

    pose: Pose
    value: Float[Array, ""]
    candidates: Pose
    values: Float[Array, " candidates"]
    trajectories: Trajectories | None = None
    standard_errors: Float[Array, " candidates"] | None = None
    difference_errors: Float[Array, " candidates"] | None = None
    standard_error: Float[Array, ""] | None = None
    value_at_visited: Float[Array, ""] | None = None

    def in_world(self, frame: Frame, length_power: int) -> "Proposal":
        """The proposal with values and errors in world units (powers of length). Poses stay in the scene."""

        def convert(leaf):
            return leaf if isinstance(leaf, Pose) else frame.length_to_world(leaf, length_power)

        return jax.tree.map(convert, self, is_leaf=lambda leaf: isinstance(leaf, Pose))

    def tied_with_best(self, errors: float = 2.0) -> Bool[Array, " candidates"] | None:
        """Mask of the candidates that are tied with the best one (itself included); None without errors.

        A value ties if it differs from the best by at most `errors` standard errors of the difference plus
        `value_at_visited`.
        """
        if self.difference_errors is None:
            return None
        best, bias = jnp.max(self.values), 0.0 if self.value_at_visited is None else self.value_at_visited
        return (self.values == best) | (best - self.values <= errors * self.difference_errors + bias)

    def best(self, count: int, apart: float = 30.0) -> Pose:
        """A batch of the best candidates from different directions, best first.

        Takes the candidates by falling value, and skips each that the origin sees within `apart` degrees of one that
        was taken. The batch is shorter than `count` if no candidate is left. Excluded ones are never taken.

        **Raises:** `ValueError` for a count below 1, or an angle outside [0, 180].
        """
        require(count >= 1, f"the count is {count}: give the number of candidates, at least 1")
        require(0.0 <= apart <= 180.0, f"apart is {apart}: give an angle in degrees, from 0 to 180")
        values, positions = np.asarray(self.values), np.asarray(self.candidates.position, np.float64)
        directions = positions / np.maximum(np.linalg.norm(positions, axis=-1, keepdims=True), 1e-30)
        least, chosen = np.cos(np.radians(apart)), list[int]()
        for index in np.argsort(-values, stable=True).tolist():
            near = directions[chosen] @ directions[index] > least
            if values[index] > -np.inf and not near.any() and len(chosen) < count:
                chosen.append(index)
        return self.candidates[np.array(chosen, int)]

    @property
    def num_tied(self) -> int | None:
        """Number of other candidates that are tied with the best one; None if errors are unknown."""
        tied = self.tied_with_best()
        if tied is None or bool(jnp.isnan(jnp.asarray(self.difference_errors)).any()):
            return None
        return int(jnp.sum(tied)) - 1
