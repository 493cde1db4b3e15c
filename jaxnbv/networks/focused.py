"""A classifier for objects of which only a small part is the cue of the class."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from jaxnbv.checks import require
from jaxnbv.geometry.farthest_points import farthest_point_indices
from jaxnbv.networks.feature_propagation import interpolate
from jaxnbv.networks.invariant import InvariantClassifier
from jaxnbv.networks.pair_level import PairLevel, affine

_CENTERS = 384


class Focus(eqx.Module):
    """For every point, whether it is on the cue of the class; rotations and translations leave the answers as they are.

    The edges around each point, what lies around farthest point samples of them, carried back to the points, and a
    perceptron of both; about 12,000 parameters.
    """

    edge: PairLevel
    around: PairLevel
    head: tuple[eqx.nn.Linear, ...]

    def __init__(self, key: PRNGKeyArray):
        edge_key, around_key, first_key, last_key = jax.random.split(key, 4)
        self.edge = PairLevel(0, 16, 32, 0.25, 0, 24, edge_key)
        self.around = PairLevel(32, 48, 48, 0.8, _CENTERS, 32, around_key)
        self.head = (eqx.nn.Linear(80, 48, key=first_key), eqx.nn.Linear(48, 1, key=last_key))

    def __call__(
        self, points: Float[Array, "n 3"], normals: Float[Array, "n 3"], mask: Bool[Array, " n"]
    ) -> Float[Array, " n"]:
        """The logarithm of the odds that a point is on the cue; of masked rows it means nothing."""
        edges = self.edge((points, normals), (points, normals, None), mask)
        order = farthest_point_indices(points, mask, self.around.groups)
        around = self.around((points[order], normals[order]), (points, normals, edges), mask)
        carried = interpolate(points, points[order], around)
        first, last = self.head
        return affine(last, jax.nn.relu(affine(first, jnp.concatenate([edges, carried], axis=-1))))[:, 0]


class FocusedClassifier(eqx.Module):
    """The class by those points alone that tell it.

    - `focus`: which these are; it is not sure of a point below even odds.
    - `network`: the classifier of these, or of no points at all where there are none.
    - `num_points`: how many it is fed, the first of them.

    **Raises:** `ValueError` if `num_points` is not positive.
    """

    focus: Focus
    network: InvariantClassifier
    num_points: int = eqx.field(static=True, default=320)

    def __check_init__(self):
        require(self.num_points >= 1, f"num_points is {self.num_points}; the network needs at least one")

    @property
    def classes(self) -> tuple[str, ...] | None:
        """Their names, where known."""
        return self.network.classes

    @property
    def temperature(self) -> Float[Array, ""]:
        """That of the network."""
        return self.network.temperature

    def __call__(
        self, points: Float[Array, "n 3"], normals: Float[Array, "n 3"], mask: Bool[Array, " n"] | None = None
    ) -> Float[Array, " classes"]:
        """Log-probabilities of the classes; the normals are unit. Masked rows do not matter."""
        mask = jnp.ones(len(points), bool) if mask is None else mask
        return self.network(*self.chosen(points, normals, mask))

    def chosen(
        self, points: Float[Array, "n 3"], normals: Float[Array, "n 3"], mask: Bool[Array, " n"]
    ) -> tuple[Float[Array, "few 3"], Float[Array, "few 3"], Bool[Array, " few"]]:
        """What the network is fed: in farthest point order these are farthest point samples of the cue of the class."""
        on_cue = mask & (self.focus(points, normals, mask) > 0.0)
        index = jnp.argsort(~on_cue, stable=True)[: self.num_points]
        return points[index], normals[index], on_cue[index]
