"""Which of some known parts an object is, and how it lies: views by what they tell about the hypotheses."""

from collections.abc import Sequence
from typing import Any, ClassVar, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxnbv.acquisition import Acquisition, ImaginedView
from jaxnbv.checks import InputError, check_fields, require
from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.pose import Pose
from jaxnbv.sampler import StepInputs
from jaxnbv.scanning import Grid, GridSurface, scan
from jaxnbv.scanning.grid import samples_at_once
from jaxnbv.sharding import shared_map
from jaxnbv.surfaces.part_evidence import KAPPA, MOST, misfit_of, weight_of
from jaxnbv.surfaces.part_hypotheses import NONE, PartHypotheses, hypotheses_of
from jaxnbv.utility import Answer, Quantity

# Hypotheses that are imagined, and the nodes along an axis of their surfaces.
_NUM_IMAGINED, _RESOLUTION = 24, 64
# How far each ray goes to a part, the cosine of its incidence, and whether it meets the part.
_Image: TypeAlias = tuple[Float[Array, "..."], Float[Array, "..."], Bool[Array, "..."]]


class ImaginedParts(eqx.Module):
    """What the value of a view depends on.

    - `surfaces`: of the likeliest hypotheses; `weights`: theirs, which sum to one.
    - `classes`: (h, c) what each hypothesis counts as, a one in each row.
    """

    surfaces: GridSurface
    weights: Float[Array, " h"]
    classes: Float[Array, "h c"]


class Identify(Acquisition):
    """Expected information about which part the object is and how it lies, in nats:

        alpha(theta) = H(w) - sum_h w_h H(w | z_h),   w_h' | z_h  proportional to  w_h' exp(-kappa L(z_h, z_h'))

    over the likeliest hypotheses h of a model that knows parts (`KnownShapes` with a bank at true size), z_h the depth
    image of h from theta, and L the misfit of images by which the hypotheses are weighed, see `part_evidence`. Every
    hypothesis is rendered once a pose, and images are compared in pairs. It needs no posterior.

    - `pose`: whether how it lies counts, or the name alone.
    - `group`: what each part of the bank counts as where the question is another one, "left" or "right" say:
      `[name.split("-")[0] for name in bank.names]`.

    **Raises:** `ValueError` for a group that is no list of names.
    """

    needs_hypotheses: ClassVar[bool] = True
    pose: bool = eqx.field(static=True, default=True)
    group: tuple[str, ...] | None = eqx.field(static=True, default=None, converter=lambda names: _as_group(names))

    def __check_init__(self):
        check_fields(self)

    def context(self, step: StepInputs) -> ImaginedParts:
        """The likeliest hypotheses as surfaces."""
        observations, hypotheses = step.observations, hypotheses_of(step.observations)
        grid = Grid() if observations.grid is None else observations.grid
        grid = Grid(min(_RESOLUTION, grid.resolution), grid.half_extent)
        shapes = hypotheses.placed.shape[:_NUM_IMAGINED]
        weights = hypotheses.weights[: len(shapes)]
        weights = weights / jnp.maximum(jnp.sum(weights), 1e-30)
        classes = self._classes(shapes, len(hypotheses.bank))
        return ImaginedParts(hypotheses.surfaces(grid, len(shapes)), weights, classes)

    def _classes(self, shapes: Int[Array, " h"], num_parts: int) -> Float[Array, "h c"]:
        if self.group is None:
            return jnp.eye(len(shapes)) if self.pose else jax.nn.one_hot(shapes, num_parts)
        require(
            len(self.group) == num_parts, f"the group has {len(self.group)} names for {num_parts} parts: give one each"
        )
        _, numbers = np.unique(self.group, return_inverse=True)
        return jax.nn.one_hot(jnp.asarray(numbers)[shapes], int(numbers.max()) + 1)

    def score(self, context: Any, view: ImaginedView) -> Float[Array, ""]:
        """**Raises:** `ValueError` always: a view is worth what it tells hypotheses apart, not what it shows of one."""
        raise InputError("Identify scores no single scan: ask its sample_scores")

    def sample_scores(
        self,
        context: ImaginedParts,
        surfaces: GridSurface,
        camera: Camera,
        poses: Pose,
        barrier: Float[Array, "poses rays"] | None = None,
    ) -> Float[Array, "1 poses"]:
        """The information that is expected of each pose; the surfaces are those of the context."""
        at_once = samples_at_once(camera, poses)
        images = shared_map(_image, context.surfaces, camera, poses, barrier, at_once=at_once)
        by_pose = jax.tree.map(lambda rows: jnp.moveaxis(rows, 1, 0), images)
        return shared_map(_information, by_pose, context.weights, context.classes, camera)[None]

    @property
    def quantity(self) -> Quantity:
        meaning = "information about which part it is and how it lies that a view is expected to give."
        return Quantity("expected information", "nats", meaning)


class IdentityAnswer(Answer):
    """The probability of each part of a bank by its name, or of each group of parts, and last of "none of these"."""

    form: str = "{:.2f}"


def identity_answer(hypotheses: PartHypotheses, acquisition: Acquisition) -> IdentityAnswer:
    """Which part the object is; which group of parts, for `Identify(group=...)`."""
    group = acquisition.group if isinstance(acquisition, Identify) else None
    names, numbers = np.unique(hypotheses.bank.names if group is None else group, return_inverse=True)
    weights = np.bincount(numbers, np.asarray(hypotheses.shape_weights, np.float64), len(names))
    return IdentityAnswer((*names.tolist(), NONE), np.append(weights, float(hypotheses.weights[-1])))


def _image(surface: GridSurface, camera: Camera, poses: Pose, barrier: Float[Array, "poses rays"] | None) -> _Image:
    """What a part shows from each of a batch of poses."""
    scans = scan(surface, camera, poses, barrier)
    offset = scans.points - poses.position[:, None]
    away = jnp.linalg.norm(offset, axis=-1)
    cosine = jnp.abs(jnp.sum(offset * scans.normals, axis=-1)) / jnp.where(scans.mask, away, 1.0)
    return away, cosine, scans.mask


def _information(
    images: _Image, weights: Float[Array, " h"], classes: Float[Array, "h c"], camera: Camera
) -> Float[Array, ""]:
    """The information of one pose, given the images of all hypotheses from there."""

    reach, _, hits = images
    weight = weight_of(jnp.sum(jnp.where(hits, reach, 0.0)) / jnp.maximum(jnp.sum(hits), 1), camera)

    def after(image):
        misfit = weight * jnp.sum(_misfits(image, images), axis=-1)
        return jax.nn.softmax(jnp.log(weights) - KAPPA * misfit)

    left = entropy(jnp.matmul(jax.lax.map(after, images), classes, precision="highest"))
    return entropy(weights @ classes) - jnp.sum(weights * left)


def _misfits(image: _Image, others: _Image) -> Float[Array, "h rays"]:
    """The misfit of each ray where one part is there and others are expected: by how far apart their surfaces are, and
    C where a ray meets one of them only."""
    (reach, _, hits), (expected, cosine, are_expected) = image, others
    both = hits & are_expected
    apart = misfit_of(jnp.where(both, (reach - expected) * cosine, 0.0))
    return jnp.where(both, apart, jnp.where(hits ^ are_expected, MOST, 0.0))


def entropy(weights: Float[Array, "*n c"]) -> Float[Array, "*n"]:
    """In nats."""
    return -jnp.sum(jax.scipy.special.xlogy(weights, jnp.maximum(weights, 1e-30)), axis=-1)


def _as_group(names: Sequence[str] | None) -> tuple[str, ...] | None:
    if names is None:
        return None
    given = tuple(names)
    require(all(isinstance(name, str) for name in given), "the group must name what each part of the bank counts as")
    return given
