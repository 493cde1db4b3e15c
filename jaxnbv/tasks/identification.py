"""Identification: which known part is the object, and what is its pose?"""

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
from jaxnbv.surfaces.part_evidence import MAX_MISFIT, misfit_of, ray_weight
from jaxnbv.surfaces.part_hypotheses import NONE, PartHypotheses, hypotheses_of
from jaxnbv.surfaces.shape_bank import ShapeBank
from jaxnbv.utility import Answer, Quantity

# Number of nodes along each axis of the grid for the surfaces of the hypotheses.
_RESOLUTION = 64
# Weight of the information about the part's pose, relative to the information about its name.
_POSE_WEIGHT = 0.1
# For each ray: distance to the part, cosine of the angle of incidence, and whether the ray hits the part.
_Image: TypeAlias = tuple[Float[Array, "..."], Float[Array, "..."], Bool[Array, "..."]]


class ImaginedParts(eqx.Module):
    """Context of the acquisition `Identify`: the hypotheses of a step, ready to be scanned.

    - `surfaces`: surface of the part in each of the h hypotheses.
    - `weights`: probabilities of the hypotheses without "none of these", scaled to sum to one.
    - `classes`: for each hypothesis, the name or group of its part as a one-hot row.
    - `tau`: scale of the distance between a measured point and the surface, in scene units, see `part_evidence`.
    - `pose_weight`: factor of I(h | c) in the formula of `Identify`.
    """

    surfaces: GridSurface
    weights: Float[Array, " h"]
    classes: Float[Array, "h c"]
    tau: Float[Array, ""]
    pose_weight: float


class Identify(Acquisition):
    """Expected information in nats about the name of the part and, with less weight, about its pose:

        alpha(theta) = I(c) + 0.1 I(h | c),   I(c) = H(c) - sum_h w_h H(c | z_h),
        w_h' | z_h  proportional to  w_h' exp(-L(z_h, z_h'))

    The sum is over the hypotheses h of a model with known parts (`KnownShapes` with a bank at true size). A hypothesis
    is a part with a pose, and w_h is its probability. c is the name of the part, H is entropy, and I(h | c) is the
    information about h that c does not contain. z_h is the depth image of h from the pose theta, and w_h' | z_h is the
    probability of h' after this image. L is the misfit between two images, summed over rays and computed from
    distances as in `part_evidence`. The name has the larger weight, because a search that first determines the pose
    needs more views to find the name.

    - `pose`: whether to include the information about the pose.
    - `group`: a class name for each part of the bank, such as `[name.split("-")[0] for name in bank.names]`. Then c is
      the class, for example "left" or "right", instead of the part, and the information about the pose is left out.

    **Raises:** `ValueError` for a group that is not a list of names.
    """

    needs_hypotheses: ClassVar[bool] = True
    pose: bool = eqx.field(static=True, default=True)
    group: tuple[str, ...] | None = eqx.field(static=True, default=None, converter=lambda names: _as_group(names))

    def __check_init__(self):
        check_fields(self)

    def context(self, step: StepInputs) -> ImaginedParts:
        observations, hypotheses = step.observations, hypotheses_of(step.observations)
        grid = Grid() if observations.grid is None else observations.grid
        grid = Grid(min(_RESOLUTION, grid.resolution), grid.half_extent)
        shapes = hypotheses.placed.shape
        weights = hypotheses.weights[:-1] / jnp.maximum(jnp.sum(hypotheses.weights[:-1]), 1e-30)
        pose_weight = _POSE_WEIGHT if self.pose and self.group is None else 0.0
        classes = self._classes(shapes, len(hypotheses.bank))
        return ImaginedParts(hypotheses.surfaces(grid, len(shapes)), weights, classes, hypotheses.tau, pose_weight)

    def _classes(self, shapes: Int[Array, " h"], num_parts: int) -> Float[Array, "h c"]:
        if self.group is None:
            return jax.nn.one_hot(shapes, num_parts)
        require(
            len(self.group) == num_parts, f"the group has {len(self.group)} names for {num_parts} parts: give one each"
        )
        _, numbers = np.unique(self.group, return_inverse=True)
        return jax.nn.one_hot(jnp.asarray(numbers)[shapes], int(numbers.max()) + 1)

    def score(self, context: Any, view: ImaginedView) -> Float[Array, ""]:
        """Raise `ValueError`, because the value of a view depends on the scans of all hypotheses together."""
        raise InputError("Identify cannot score a single scan: use its sample_scores")

    def sample_scores(
        self,
        context: ImaginedParts,
        surfaces: GridSurface,
        camera: Camera,
        poses: Pose,
        barrier: Float[Array, "poses rays"] | None = None,
    ) -> Float[Array, "1 poses"]:
        """Return the expected information of each pose, from scans of `context.surfaces`. Ignores `surfaces`."""
        at_once = samples_at_once(camera, poses)
        images = shared_map(_image, context.surfaces, camera, poses, barrier, at_once=at_once)
        by_pose = jax.tree.map(lambda rows: jnp.moveaxis(rows, 1, 0), images)
        return shared_map(_information, by_pose, context, camera)[None]

    @property
    def quantity(self) -> Quantity:
        meaning = "information about which part it is, and a tenth of that about how it lies, that a view should give."
        return Quantity("expected information", "nats", meaning)


class IdentityAnswer(Answer):
    """Probability of each part of a bank, or of each group of parts. The last entry is "none of these"."""

    form: str = "{:.2f}"


def identity_answer(hypotheses: PartHypotheses, acquisition: Acquisition) -> IdentityAnswer:
    """Return the probabilities of the parts, or of the groups of parts for `Identify(group=...)`."""
    names, values = weights_by_name(hypotheses.bank, np.asarray(hypotheses.part_weights), acquisition)
    return IdentityAnswer((*names, NONE), values)


def weights_by_name(
    bank: ShapeBank, weights: Float[np.ndarray, "*batch k_and_none"], acquisition: Acquisition
) -> tuple[list[str], Float[np.ndarray, "*batch n"]]:
    """Return the names of a bank's parts in alphabetical order, and the weights in this order.

    There is one weight more than names: the last is that of "none of these". For `Identify(group=...)`, the names are
    those of the groups, and the weights of the parts in a group are added.

    - `weights`: weights of the parts in the order of the bank, then that of "none of these", as in
      `PartHypotheses.part_weights`, with any leading axes.
    """
    group = acquisition.group if isinstance(acquisition, Identify) else None
    names, numbers = np.unique(bank.names if group is None else group, return_inverse=True)
    rows = weights.reshape(-1, weights.shape[-1]).astype(np.float64)
    values = np.stack([np.append(np.bincount(numbers, row[:-1], len(names)), row[-1]) for row in rows])
    return names.tolist(), values.reshape(*weights.shape[:-1], -1)


def _image(surface: GridSurface, camera: Camera, poses: Pose, barrier: Float[Array, "poses rays"] | None) -> _Image:
    scans = scan(surface, camera, poses, barrier)
    offset = scans.points - poses.position[:, None]
    distances = jnp.linalg.norm(offset, axis=-1)
    cosine = jnp.abs(jnp.sum(offset * scans.normals, axis=-1)) / jnp.where(scans.mask, distances, 1.0)
    return distances, cosine, scans.mask


def _information(images: _Image, context: ImaginedParts, camera: Camera) -> Float[Array, ""]:
    """Return the expected information of one pose, given the images of all hypotheses from this pose."""
    (reach, _, hits), weights = images, context.weights
    weight = ray_weight(jnp.sum(jnp.where(hits, reach, 0.0)) / jnp.maximum(jnp.sum(hits), 1), camera)

    def weights_after(image):
        misfit = weight * jnp.sum(_misfits(image, images, context.tau), axis=-1)
        return jax.nn.softmax(jnp.log(weights) - misfit)

    all_weights_after = jax.lax.map(weights_after, images)

    def information(classes):
        entropies = entropy_of_weights(jnp.matmul(all_weights_after, classes, precision="highest"))
        return entropy_of_weights(weights @ classes) - jnp.sum(weights * entropies)

    class_information = information(context.classes)
    return class_information + context.pose_weight * (information(jnp.eye(len(weights))) - class_information)


def _misfits(image: _Image, others: _Image, tau: Float[Array, ""]) -> Float[Array, "h rays"]:
    """Return each ray's misfit between the image of one hypothesis and the image of each hypothesis.

    The misfit grows with the distance between the two surfaces, measured along the ray and multiplied by the cosine of
    the angle of incidence. It is `MAX_MISFIT`, its largest value, if the ray hits only one of the two surfaces.
    """
    (reach, _, hits), (expected, cosine, are_expected) = image, others
    both = hits & are_expected
    misfits = misfit_of(jnp.where(both, (reach - expected) * cosine, 0.0), tau)
    return jnp.where(both, misfits, jnp.where(hits ^ are_expected, MAX_MISFIT, 0.0))


def entropy_of_weights(weights: Float[Array, "*n c"]) -> Float[Array, "*n"]:
    """Return the entropy -sum_c w_c log w_c in nats, over the last axis."""
    return -jnp.sum(jax.scipy.special.xlogy(weights, jnp.maximum(weights, 1e-30)), axis=-1)


def _as_group(names: Sequence[str] | None) -> tuple[str, ...] | None:
    if names is None:
        return None
    require(
        not isinstance(names, str),
        f"the group is the text {names!r}: give a list with a class name for each part, such as ['left', 'right']",
    )
    group = tuple(names)
    require(
        all(isinstance(name, str) for name in group),
        "the group must be a list with a class name for each part of the bank",
    )
    return group
