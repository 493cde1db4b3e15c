"""What the pictures of an episode show, as plain arrays: computed once a view, drawn by `report` and `figures`."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import trimesh
from jaxtyping import Float, Int
from scipy.ndimage import map_coordinates
from scipy.spatial import cKDTree

from jaxnbv.acquisition import Quantity
from jaxnbv.checks import AnyArray
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.farthest_points import farthest_point_indices
from jaxnbv.geometry.frame import Frame
from jaxnbv.geometry.pose import Pose
from jaxnbv.imagination import Imagination
from jaxnbv.planning.episode import Episode, View, view_keys
from jaxnbv.progress import progress_bar
from jaxnbv.scanning import Evidence, Grid, GridSurface
from jaxnbv.scanning.mesh import level_triangles
from jaxnbv.scanning.metrics import coverage, truth_points
from jaxnbv.surfaces import SurfacePosterior
from jaxnbv.viz.answers import words_of
from jaxnbv.viz.choice import Ascents, Choice, choice_of, wider_map
from jaxnbv.viz.imagined import Imagined, Look, imagined, look
from jaxnbv.viz.stage import Stage, stage_of
from jaxnbv.viz.task import Task, task_of
from jaxnbv.viz.words import Told, describe_choice, describe_first

# The variance of one point costs a triangular solve with the whole cloud, the slope two evaluations of the mean.
_DEVIATION_ANCHORS = 256
_SLOPE_ANCHORS = 1024
_SLOPE_STEP = 0.005
# Of the distance to the nearest point. On a cow after one to five views the surface is off by 0.2 to 0.3 of it (root
# mean square) between 0.1 and 0.4 from the points, two to three of the posterior's standard deviations; the other way
# round, from the truth to the surface, which may lack a part, by 0.4 to 0.7.
_UNSEEN = 0.25


class MeanSurface(eqx.Module):
    """Triangles of the surface where the posterior mean equals its level, in scene coordinates.

    - `normals`: unit, outward.
    - `deviation`: standard deviation of the surface's position along its normal, to first order:
      sd f(x) / |grad E f(x)|, in scene units.
    """

    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    normals: Float[np.ndarray, "v 3"]
    deviation: Float[np.ndarray, " v"]

    @property
    def mesh(self) -> trimesh.Trimesh:
        """Its triangles alone."""
        return trimesh.Trimesh(self.vertices, self.faces, process=False)


class ViewData(eqx.Module):
    """One view, ready to be drawn.

    - `number`: from 1.
    - `before`: points kept before this view; `new`: points it added. Scene coordinates.
    - `surface`: with a deviation that allows for what was not seen; None where the posterior mean has no surface within
      the grid.
    - `choice`: None for a view that was given.
    - `coverage`: share of the true surface that was seen; None where the truth is not known.
    - `count`: points of the cloud after this view.
    - `told`: what happened, in words.
    - `imagined`: what was imagined before it was taken; None for a view that was given.
    - `look`: the scan itself; None where it is no image.
    """

    number: int
    pose: Pose
    before: Float[np.ndarray, "n 3"]
    new: Float[np.ndarray, "m 3"]
    surface: MeanSurface | None
    choice: Choice | None
    coverage: float | None
    count: int
    told: Told
    imagined: Imagined | None = None
    look: Look | None = None

    @property
    def sentence(self) -> str:
        """What happened, in words."""
        return self.told.sentence(self.number)

    @property
    def spatial_ascents(self) -> Ascents | None:
        """The trajectories that led to this view, where they left the sphere."""
        ascents = None if self.choice is None else self.choice.ascents
        return None if ascents is None or not ascents.is_spatial else ascents

    @property
    def extent(self) -> float:
        """Distance from the origin to the farthest camera of this view and its ascents."""
        ascents = self.spatial_ascents
        positions = [self.pose.position] if ascents is None else [self.pose.position, ascents.poses.position]
        return max(float(np.linalg.norm(position, axis=-1).max()) for position in positions)


class ReportData(eqx.Module):
    """All views of an episode, what the values of its search mean, what the views were for, whence they are drawn.

    - `frame`: to the world that the object's file was given in; None where there was none.
    """

    views: tuple[ViewData, ...]
    quantity: Quantity
    task: Task
    stage: Stage
    frame: Frame | None


def report_data(
    episode: Episode,
    truth: Float[AnyArray, "n 3"] | None = None,
    progress: bool = True,
    imagine: bool = True,
    rival: Episode | None = None,
) -> ReportData:
    """Everything that the pictures of an episode show. Conditions the model once a view, and draws the samples of each
    step again; nothing recompiles after the first.

    - `truth`: points of the true surface (scene coordinates); by default sampled from the scene, where it can be.
    - `imagine`: whether what the steps imagined is shown.
    - `rival`: an episode of another search from the same first view.
    """
    planner = episode.planner
    if truth is None and episode.scene is not None:
        truth = truth_points(episode.scene, jax.random.key(0))

    def covered_by(views: tuple[View, ...]) -> list[float | None]:
        return [None] * len(views) if truth is None else [*coverage(views, truth)]

    covered = covered_by(episode.views)
    task = task_of(episode, covered, rival, () if rival is None else covered_by(rival.views))
    drawn: list[ViewData] = []
    known: tuple[Evidence, SurfacePosterior, GridSurface] | None = None
    steps, count = zip(episode.views, episode.evidence(), strict=True), len(episode.views)
    bar = progress_bar(steps, progress, desc="drawing views", total=count)
    for index, (view, after) in enumerate(bar):
        choice = None if view.proposal is None else choice_of(view.proposal, wider_map(episode, index))
        new, _ = view.scan.to_numpy()
        before = episode.views[index - 1].cloud.to_numpy()[0] if index else np.zeros((0, 3), new.dtype)
        posterior = planner.imagination.posterior(after)
        is_image = view.scan.capacity == view.camera.num_rays
        taken = look(view.scan, view.camera, view.pose, before) if is_image else None
        # With the key of the next step: what it imagined, and moments where the posterior has no closed ones.
        surfaces = None
        if (imagine and index + 1 < count) or not posterior.has_closed_forms:
            surfaces = planner.imagination.sample(after, view_keys(episode.key, index + 1)[0], posterior)
        drawn.append(
            ViewData(
                number=index + 1,
                pose=view.pose,
                before=before,
                new=new,
                surface=allowing_for_unseen(mean_surface(planner.imagination, after, posterior, surfaces), view.cloud),
                choice=choice,
                coverage=covered[index],
                count=int(view.cloud.count),
                told=_told(episode, index, choice, covered, task),
                imagined=imagined(episode, index, *known, taken) if imagine and known is not None else None,
                look=taken,
            )
        )
        known = None if surfaces is None else (after, posterior, surfaces)
    means = [view.surface.mesh for view in drawn if view.surface is not None]
    frame = getattr(episode.scene, "frame", None)
    return ReportData(tuple(drawn), planner.quantity, task, stage_of(episode, means), frame)


def _told(episode: Episode, index: int, choice: Choice | None, covered: list[float | None], task: Task) -> Told:
    view, before = episode.views[index], covered[index - 1] if index else None
    points, after = int(view.scan.count), covered[index]
    if choice is None or not index:
        told = describe_first(view.pose, points, after)
    else:
        earlier = [other.pose for other in episode.views[:index]]
        change = None if before is None or after is None else (before, after)
        count = int(view.cloud.count)
        told = describe_choice(episode.planner.quantity, choice, view.pose, earlier, points, count, change)
    if not task.is_coverage:
        answer = words_of(task.answers[index]).sentence(task.answers[index - 1] if index else None)
        told = told._replace(came=f"{told.came} {answer}")
    return told


def mean_surface(
    imagination: Imagination, evidence: Evidence, posterior: SurfacePosterior, surfaces: GridSurface | None = None
) -> MeanSurface | None:
    """The surface of the mean of the posterior given the evidence, carved as the samples are, with its standard
    deviation; None if the grid holds none.

    - `surfaces`: samples of it, by which a posterior without closed forms is drawn; by default under a fixed key.
    """
    if not posterior.has_closed_forms:
        surfaces = imagination.sample(evidence, jax.random.key(0), posterior) if surfaces is None else surfaces
        return _mean_of_samples(np.asarray(surfaces.values, np.float64), imagination.grid)
    found = level_triangles(np.array(imagination.mean(evidence, posterior)), imagination.grid)
    if found is None:
        return None
    vertices, faces, normals = found
    # Along the normals too, so that the two sides of a thin sheet are told apart.
    features = np.concatenate([vertices, 0.1 * normals], axis=1)
    anchors = _spread(features, _SLOPE_ANCHORS)
    few = anchors[:_DEVIATION_ANCHORS]
    dtype = evidence.cloud.points.dtype
    variance = np.asarray(posterior.variance(vertices[few].astype(dtype)))
    step = _SLOPE_STEP * normals[anchors]
    ahead, behind = (np.asarray(posterior.mean((vertices[anchors] + s).astype(dtype))) for s in (step, -step))
    slope = np.abs(ahead - behind) / (2.0 * _SLOPE_STEP)
    spread = _interpolate(features, few, np.sqrt(np.maximum(variance, 1e-30)))
    deviation = spread / _interpolate(features, anchors, np.maximum(slope, 1e-6))
    return MeanSurface(vertices, faces, normals, deviation)


def _mean_of_samples(values: Float[np.ndarray, "s g g g"], grid: Grid) -> MeanSurface | None:
    mean = values.mean(axis=0)
    found = level_triangles(mean, grid)
    if found is None:
        return None
    vertices, faces, normals = found
    place = (vertices + grid.half_extent).T / grid.spacing
    slope = np.linalg.norm([map_coordinates(part, place, order=1) for part in np.gradient(mean, grid.spacing)], axis=0)
    spread = map_coordinates(values.std(axis=0, ddof=min(1, len(values) - 1)), place, order=1)
    return MeanSurface(vertices, faces, normals, spread / np.maximum(slope, 1e-6))


def allowing_for_unseen(surface: MeanSurface | None, cloud: PointCloud) -> MeanSurface | None:
    """The surface with the deviation sqrt(sd^2 + (r / 4)^2), r the distance to the nearest point of the cloud.

    The posterior is too sure of what no ray has met, beside the image's border or behind the object: it takes its own
    continuation of what was seen for known. An end that was not seen is to be shown as such.
    """
    if surface is None:
        return None
    away, _ = cKDTree(cloud.to_numpy()[0]).query(surface.vertices)
    return dataclasses.replace(surface, deviation=np.hypot(surface.deviation, _UNSEEN * away))


def _spread(features: np.ndarray, count: int) -> np.ndarray:
    """`count` rows far from each other, in order of choice; the first again and again where there are fewer rows."""
    # Padded to a power of two, so that surfaces of other sizes share a compilation.
    capacity = 1 << (len(features) - 1).bit_length()
    padded = np.pad(features.astype(np.float32), ((0, capacity - len(features)), (0, 0)))
    return np.asarray(farthest_point_indices(jnp.asarray(padded), jnp.arange(capacity) < len(features), count))


def _interpolate(features: np.ndarray, anchors: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Values at all rows from those at the anchors, positive throughout: a Gaussian mean of the nearest logarithms."""
    distance, near = cKDTree(features[anchors]).query(features, k=min(8, len(anchors)))
    width = 0.5 * distance[:, -1:] + 1e-12
    weight = np.exp(-0.5 * (distance / width) ** 2) + 1e-12
    return np.exp(np.sum(weight * np.log(values)[near], axis=1) / np.sum(weight, axis=1))
