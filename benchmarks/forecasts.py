"""Scores of a planner's posterior samples against the true surface.

The samples are forecasts of the depth along a ray, of whether a place is inside, and of the value of a view. They are
judged by proper scores (Gneiting and Raftery 2007), whose expectation is least for the true distribution, in the forms
that are fair to small ensembles (Ferro 2014), so that no number of samples is at an advantage.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxnbv.acquisition import Acquisition, expected_value, inputs_of, scores
from jaxnbv.checks import AnyArray, InputError, require
from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.pose import Pose
from jaxnbv.geometry.tensor_grid import on_tensor_grid
from jaxnbv.geometry.volume import Box, ray_interval
from jaxnbv.observations import Observations
from jaxnbv.planning.planner import Planner
from jaxnbv.scanning import Grid, GridSurface, SDFSurface, Surface, TriangleMesh, scan
from jaxnbv.studies.classification.measures import rank_correlation

BINS = 10
_scan = eqx.filter_jit(scan)


class Truth(eqx.Module):
    """The true surface as arrays, so that one compiled program judges samples against any object.

    - `candidates`: poses of the imagined scans.
    - `camera`: the camera of the depths.
    - `volume`: where the object can be.
    - `inside`: the nodes of the planner's grid inside the solid; all False for a surface that encloses nothing.
    - `depths`: result of `ray_depths`, without noise.
    - `scans`: scans by the planner's camera from the candidates, without noise, as in imagined scans.
    """

    candidates: Pose
    camera: Camera
    volume: Box
    inside: Bool[Array, "g g g"]
    depths: Float[Array, "candidates rays"]
    scans: PointCloud

    @classmethod
    def of(cls, scene: Surface, planner: Planner, candidates: Pose, volume: Box, camera: Camera = Camera()) -> "Truth":
        """The truth of a known surface, in scene coordinates.

        **Raises:** `ValueError` for a kind of surface whose inside is not known.
        """
        inside = _inside(scene, planner.sampler.grid)
        look = _scan if scene.in_jit else scan
        scans = look(scene, camera, candidates)
        depths = ray_depths(scans, camera, candidates, volume)[0]
        return cls(candidates, camera, volume, inside, depths, look(scene, planner.camera, candidates))


class Reliability(NamedTuple):
    """Forecast probabilities in bins of equal width. Means of an empty bin are None.

    - `forecast`: mean forecast. `observed`: share of events that happened. `nodes`: number of forecasts.
    """

    forecast: list[float | None]
    observed: list[float | None]
    nodes: list[int]


class Judgement(NamedTuple):
    """Scores of the samples of one step. Undefined ones are None.

    - `crps`: of the depth, mean over rays, in scene units. Less is better, as for the Brier scores.
    - `brier`, `fair_brier`: of being inside, mean over the unseen nodes. They and the next three are None for a surface
      that encloses nothing. The plain score uses the share of the samples as probability; the fair one corrects for
      the sampling error of this share.
    - `mean_inside`, `true_inside`: mean probability of being inside, and the true share inside, at the same nodes.
    - `reliability`: of the same probabilities.
    - `in_empty`: share of the imagined hits that lie in space seen to be empty; None without hits.
    - `rank`: Spearman's correlation of the acquisition with the true values of the candidates.
    - `share_of_best`: true value of the candidate with the greatest acquisition, as a share of the greatest true value.
    """

    crps: float
    brier: float | None = None
    fair_brier: float | None = None
    mean_inside: float | None = None
    true_inside: float | None = None
    reliability: Reliability | None = None
    in_empty: float | None = None
    rank: float | None = None
    share_of_best: float | None = None


def judge(
    planner: Planner,
    observations: Observations,
    surfaces: GridSurface,
    truth: Truth,
    empty_nodes: Bool[AnyArray, "g g g"],
) -> Judgement:
    """Scores of `surfaces`, the planner's samples given the observations.

    - `empty_nodes`: nodes that the scans have shown to be empty, whether or not the planner carves by them. All
      planners are judged on the same nodes: those inside the volume that were not seen to be empty.

    **Raises:** `ValueError` if the truth is on another grid, or there are fewer than two samples.
    """
    shape = (planner.sampler.grid.resolution,) * 3
    require(
        truth.inside.shape == empty_nodes.shape == shape,
        f"the truth is on {truth.inside.shape} nodes and the seen space on {empty_nodes.shape}, but the planner's grid "
        f"has {shape}: make both with the planner's grid",
    )
    empty_nodes = jnp.asarray(empty_nodes)
    arrays = _judge(surfaces, observations.cloud, truth, empty_nodes, planner.camera, planner.acquisition)
    crps_depth, in_empty, probabilities, expected, true_values = (np.asarray(leaf) for leaf in arrays)
    record = Judgement(
        crps=float(crps_depth),
        in_empty=None if np.isnan(in_empty) else float(in_empty),
        rank=rank_correlation(expected, true_values, np.ones(len(true_values), bool)),
        share_of_best=share_of_best(expected, true_values),
    )
    if not bool(truth.inside.any()):
        return record
    is_unseen = np.asarray((_over_nodes(truth.volume, planner.sampler.grid) <= 0) & ~empty_nodes)
    forecast, outcomes = probabilities[is_unseen], np.asarray(truth.inside)[is_unseen]
    plain_brier = brier(forecast, outcomes)
    return record._replace(
        brier=plain_brier,
        fair_brier=plain_brier - float(np.mean(forecast * (1.0 - forecast))) / (surfaces.values.shape[0] - 1),
        mean_inside=float(forecast.mean()),
        true_inside=float(outcomes.mean()),
        reliability=reliability(forecast, outcomes),
    )


def crps(samples: Float[AnyArray, "s *n"], truth: Float[AnyArray, "*n"]) -> Float[Array, "*n"]:
    """Continuous ranked probability score of an ensemble, element by element, in the unit of the samples:

        mean_s |x_s - y| - sum_{s, s'} |x_s - x_s'| / (2 S (S - 1)).

    This is the fair estimator: it is unbiased for the score of the samples' distribution, and so sometimes negative.
    Runs under `jit`.

    **Raises:** `ValueError` for fewer than two samples.
    """
    samples, truth = jnp.asarray(samples), jnp.asarray(truth)
    count = samples.shape[0]
    require(count >= 2, f"the fair CRPS of {count} samples is not defined: draw at least two")
    # In sorted order x_(i) is above i - 1 others and below S - i, which saves the S^2 differences.
    weight = jnp.asarray(2 * np.arange(1, count + 1) - count - 1, samples.dtype)
    spread = jnp.tensordot(weight, jnp.sort(samples, axis=0), axes=1) / (count * (count - 1))
    return jnp.mean(jnp.abs(samples - truth), axis=0) - spread


def exit_depths(
    volume: Box, origins: Float[AnyArray, "*n 3"], directions: Float[AnyArray, "*n 3"]
) -> tuple[Float[Array, "*n"], Bool[Array, "*n"]]:
    """Distance at which rays leave a box, in direction lengths, and whether they meet it (Kay and Kajiya 1986)."""
    origins, directions = jnp.asarray(origins), jnp.asarray(directions)
    start, components = (list(jnp.moveaxis(vectors, -1, 0)) for vectors in (origins, directions))
    enters, leaves = ray_interval(start, components, volume.low, volume.high)
    return leaves, leaves > jnp.maximum(enters, 0.0)


def ray_depths(
    scans: PointCloud, camera: Camera, poses: Pose, volume: Box
) -> tuple[Float[Array, "*poses rays"], Bool[Array, "*poses rays"]]:
    """Depth along the rays of a scan, in scene units, and which rays meet the volume.

    A ray that misses, or hits only beyond the volume, gets the depth at which it leaves the volume. A hit before the
    volume keeps its depth.
    """
    origins, directions = camera.rays(poses)
    leaves, meets = exit_depths(volume, origins, directions)
    depth = jnp.sum((scans.points - origins) * directions, axis=-1)
    return jnp.where(scans.mask, jnp.minimum(depth, leaves), leaves), meets


def brier(forecast: Float[AnyArray, " n"], outcomes: Bool[AnyArray, " n"]) -> float:
    """Mean squared difference between probabilities and outcomes (1 or 0).

    **Raises:** `ValueError` if there are none.
    """
    require(len(forecast) > 0, "no forecasts to judge: every node of the volume was seen to be empty, or it has none")
    return float(np.mean((np.asarray(forecast) - np.asarray(outcomes)) ** 2))


def reliability(forecast: Float[AnyArray, " n"], outcomes: Bool[AnyArray, " n"], bins: int = BINS) -> Reliability:
    """Mean forecast and observed frequency by bins of the forecast, [0, 1/bins), ..., [1 - 1/bins, 1]."""
    forecast, outcomes = np.asarray(forecast, np.float64), np.asarray(outcomes)
    index = np.minimum((forecast * bins).astype(int), bins - 1)
    count = np.bincount(index, minlength=bins)

    def mean(values: np.ndarray) -> list[float | None]:
        sums = np.bincount(index, weights=values, minlength=bins)
        return [float(total / n) if n else None for total, n in zip(sums, count, strict=True)]

    return Reliability(mean(forecast), mean(outcomes), count.tolist())


def empty_share(
    points: Float[Array, "*n 3"], mask: Bool[Array, "*n"], empty: Bool[Array, "g g g"], grid: Grid
) -> Float[Array, ""]:
    """Share of the filled points (scene coordinates) whose nearest node of the grid is empty. NaN without points.

    Runs under `jit`.
    """
    node = jnp.clip(jnp.round((points + grid.half_extent) / grid.spacing), 0, grid.resolution - 1).astype(jnp.int32)
    return jnp.sum(mask & empty[node[..., 0], node[..., 1], node[..., 2]]) / jnp.sum(mask)


def share_of_best(values: Float[AnyArray, " c"], true_values: Float[AnyArray, " c"]) -> float | None:
    """True value of the candidate with the greatest value, as a share of the greatest true value. None if all are zero.

    One minus this is the relative regret.
    """
    values, true_values = np.asarray(values), np.asarray(true_values)
    best = float(true_values.max())
    return float(true_values[np.argmax(values)]) / best if best > 0 else None


@eqx.filter_jit
def _judge(
    surfaces: GridSurface,
    cloud: PointCloud,
    truth: Truth,
    empty: Bool[Array, "g g g"],
    camera: Camera,
    acquisition: Acquisition,
):
    scans = jax.lax.map(lambda surface: scan(surface, truth.camera, truth.candidates), surfaces)
    depths, meets = jax.vmap(lambda s: ray_depths(s, truth.camera, truth.candidates, truth.volume))(scans)
    error = jnp.mean(crps(depths, truth.depths), where=meets[0])
    share = empty_share(scans.points, scans.mask, empty, surfaces.grid)
    inside = jnp.mean(surfaces.values < 0, axis=0)
    expected = expected_value(acquisition, cloud, surfaces, camera, truth.candidates)
    context = acquisition.context(inputs_of(cloud))
    true_values = scores(acquisition, context, truth.scans, camera, truth.candidates)
    return error, share, inside, expected, true_values


def _inside(scene: Surface, grid: Grid) -> Bool[Array, "g g g"]:
    if isinstance(scene, TriangleMesh):
        nodes = np.stack(np.meshgrid(*[grid.axis] * 3, indexing="ij"), axis=-1)
        return jnp.asarray(scene.contains(nodes.reshape(-1, 3)).reshape(nodes.shape[:3]))
    if isinstance(scene, SDFSurface):
        return _over_nodes(scene.sdf, grid) < 0
    raise InputError(f"the inside of a {type(scene).__name__} is not known: give an SDFSurface or a TriangleMesh")


@eqx.filter_jit
def _over_nodes(distance, grid: Grid) -> Float[Array, "g g g"]:
    return on_tensor_grid(distance, jnp.asarray(grid.axis, jnp.result_type(float)))
