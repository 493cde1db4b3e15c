"""Proposals, the results of searches, and trajectories of gradient searches."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxnbv.checks import require
from jaxnbv.geometry.frame import Frame
from jaxnbv.geometry.pose import Pose


class Trajectories(eqx.Module):
    """Poses and values of a gradient search, for each start and each of its `iterations` + 1 steps."""

    poses: Pose
    values: Float[Array, "*starts steps"]

    @property
    def flat(self) -> tuple[Pose, Float[Array, " poses"]]:
        """All poses and values along a single axis: first the starts, then their first steps, and so on."""
        poses, values = jax.tree.map(lambda rows: jnp.swapaxes(rows, 0, 1), (self.poses, self.values))
        return jax.tree.map(lambda rows: rows.reshape(-1, *rows.shape[2:]), (poses, values))


class Proposal(eqx.Module):
    """Result of a search: the next pose, and the values of all poses that the search evaluated.

    - `pose`, `value`: the proposed pose and its value, in the unit of the search's quantity.
    - `candidates`, `values`: all candidates and their values. The value of an excluded candidate is -inf.
    - `trajectories`: trajectories of a gradient search from the best candidates; None for other searches.
    - `standard_errors`: standard errors of `values`. Each value is a mean over the posterior samples on which the
      candidate was scored. None for a search without scores.
    - `difference_errors`: standard errors of the differences between the values and the best value. They are smaller
      than `standard_errors`, because candidates share samples. None if not all candidates are scored on all samples.
    - `standard_error`: standard error of `value`. NaN for one sample; None for a search without scores.
    - `value_at_visited`: see `Problem.value_at_visited`. None unless the distance from earlier cameras decides ties.
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
        """Return a copy with values and errors in world units. Poses stay in scene coordinates.

        - `length_power`: power of length in the unit of the values.
        """

        def convert(leaf):
            return leaf if isinstance(leaf, Pose) else frame.length_to_world(leaf, length_power)

        return jax.tree.map(convert, self, is_leaf=lambda leaf: isinstance(leaf, Pose))

    def tied_with_best(self, errors: float = 2.0) -> Bool[Array, " candidates"] | None:
        """Return a mask of the candidates that are tied with the best; None without `difference_errors`.

        A candidate is tied if its value differs from the best value by at most `errors` standard errors of the
        difference, plus `value_at_visited`. The best candidate itself is in the mask.
        """
        if self.difference_errors is None:
            return None
        best, bias = jnp.max(self.values), 0.0 if self.value_at_visited is None else self.value_at_visited
        return (self.values == best) | (best - self.values <= errors * self.difference_errors + bias)

    def best(self, count: int, min_angle: float = 30.0) -> Pose:
        """Return a batch of the best candidates from different directions, best first.

        Excluded candidates are left out. The batch is shorter than `count` if there are not enough candidates.

        - `min_angle`: smallest angle, seen from the origin, between two candidates of the batch, in degrees.

        **Raises:** `ValueError` for a count below 1, or an angle outside [0, 180].
        """
        require(count >= 1, f"the count is {count}: give the number of candidates, at least 1")
        require(0.0 <= min_angle <= 180.0, f"min_angle is {min_angle}: give an angle in degrees, from 0 to 180")
        values, positions = np.asarray(self.values), np.asarray(self.candidates.position, np.float64)
        directions = positions / np.maximum(np.linalg.norm(positions, axis=-1, keepdims=True), 1e-30)
        max_cosine, rows = np.cos(np.radians(min_angle)), list[int]()
        for index in np.argsort(-values, stable=True).tolist():
            is_near = directions[rows] @ directions[index] > max_cosine
            if values[index] > -np.inf and not is_near.any() and len(rows) < count:
                rows.append(index)
        return self.candidates[np.array(rows, int)]

    @property
    def num_tied(self) -> int | None:
        """Number of other candidates that are tied with the best; None if `difference_errors` are unknown."""
        is_tied = self.tied_with_best()
        if is_tied is None or bool(jnp.isnan(jnp.asarray(self.difference_errors)).any()):
            return None
        return int(jnp.sum(is_tied)) - 1
