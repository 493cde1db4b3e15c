"""Several objects on a table: a session for each, which all look at the same images."""

import warnings
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int, PRNGKeyArray, Real
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from jaxnbv.checks import AnyArray, InputError, as_numbers, checked, require, shown
from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.depth_image import without_sentinels
from jaxnbv.geometry.pose import Pose
from jaxnbv.geometry.volume import Box
from jaxnbv.planning.images import Image, stride_of
from jaxnbv.planning.mount import MountError
from jaxnbv.planning.planner import Planner
from jaxnbv.planning.session import Session
from jaxnbv.planning.session_scene import box_of
from jaxnbv.planning.stopping import StopRule
from jaxnbv.planning.table import plane_of, table_under
from jaxnbv.scanning import Obstacles
from jaxnbv.scanning.sdf import HalfSpace
from jaxnbv.surfaces.part_hypotheses import hypotheses_of
from jaxnbv.surfaces.part_pose import distances_to

# Points of one object are as near as this to others of it, as a share of the longest side of the box.
_GAP = 0.02
# Fewer rays than these are no object. A cluster is compared with so many of its points.
_FEWEST, _COMPARED = 20, 256


class Sessions:
    """Several objects, each one of some known parts: a `Session` for each, which get the same images. An object is a
    cluster of what an image shows above the table, or what a segmentation of the image says.

    - `camera`, `planner`, `up`, `key`, `until`, `obstacles`, `progress`: as of `Session`; the planner is one for parts
      and searches candidates.
    - `box`: two corners of a box about all of the objects, without the table.
    - `gap`: objects that are farther apart than this are told apart without a segmentation, in world units. By default
      2 % of the longest side of the box.
    - `folder`: holds a folder of each session, with which all goes on.

    **Raises:** `ValueError` as `Session` does, or for a planner that knows no parts.
    """

    @checked
    def __init__(
        self,
        camera: Camera,
        box: tuple | list | Box | AnyArray,
        planner: Planner,
        up: str | None = None,
        obstacles: Obstacles | None = None,
        gap: float | None = None,
        folder: str | Path | None = None,
        key: PRNGKeyArray | None = None,
        until: StopRule | None = None,
        progress: bool = True,
    ):
        # It checks what is given, and places the candidates about all of the objects.
        whole = Session(camera, box, planner, up, key=key, until=until, obstacles=obstacles, progress=progress)
        bank = getattr(planner.sampler.model, "bank", None)
        if bank is None or not planner.sampler.model.carries_hypotheses:
            raise InputError("the planner knows no parts: use Planner.for_parts(bank)")
        self.camera, self.box, self.until = camera, box_of(box), until
        self._frame, self._planner, self._key = whole.frame, planner, whole.key
        self._obstacles, self._progress = obstacles, progress
        self._num_images = 0
        self._mount_error, self._warned_of_mount = MountError(camera, whole.convention), False
        self._longest_part = 2.0 * float(jnp.max(jnp.linalg.norm(bank.shapes.extremes, axis=-1)))
        self._gap = _GAP * float(np.max(self.box.high - self.box.low)) if gap is None else gap
        require(self._gap > 0, f"the gap is {gap}; it must be positive")
        candidates = self._frame.to_world(whole.planner.search.poses_around())
        self._poses = np.asarray(candidates.to_matrix(), np.float64)
        self._folder = None if folder is None else Path(folder)
        # Numbers of candidates: what `next` gave since the last image, and all that it gave.
        self._next: int | None = None
        self._proposed: list[int] = []
        self.objects: dict[int, Session] = {}
        if self._folder is not None:
            stored = sorted(int(path.name) for path in self._folder.glob("[0-9]*") if path.name.isdigit())
            self.objects = {number: self._session(number, self.box) for number in stored}

    def __repr__(self) -> str:
        return f"Sessions({', '.join(f'{number}: {session!r}' for number, session in self.objects.items())})"

    @checked
    def add(
        self,
        depth: Real[AnyArray, "height width"],
        matrix: Float[AnyArray, "4 4"] | list,
        depth_scale: float = 1.0,
        labels: AnyArray | None = None,
    ) -> None:
        """Take in an image. What stands where no object is known yet becomes one, with the next number.

        - `depth`, `matrix`, `depth_scale`: as of `Session.add`.
        - `labels`: which object each pixel shows, by the same number in all images, zero for none. By default clusters
          of the points above the table: one that meets the points of a known object, or lies on the part that it most
          likely is, belongs to it.

        **Raises:** `ValueError` as `Session.add` does, or if the image shows no object and none is known.
        """
        pixels = as_numbers(depth, "the depth image", None)
        pose = Pose.from_matrix(as_numbers(matrix, "the matrix of a pose", np.float64))
        pixels = without_sentinels(pixels, self.camera, pose, depth_scale, self.box)
        stride = stride_of(self.camera)
        cloud = PointCloud.from_depth(pixels, self.camera, pose, depth_scale, stride)
        if self._obstacles is None:
            self._obstacles = self._table_of(cloud)
        image = Image.of(pixels, matrix, depth_scale, None)
        points, inside = self._points(image, pose)
        if labels is None:
            numbers = np.zeros(pixels.shape, int)
            numbers[inside] = self._numbers(points[inside])
        else:
            numbers = as_numbers(labels, "the labels", None)
            proper = numbers.shape == pixels.shape and np.issubdtype(numbers.dtype, np.integer)
            require(proper, f"the labels are {shown(labels)}: give whole numbers, one for each of the image's pixels")
        numbers = np.where(inside, numbers, 0)
        # What a session would take from the image.
        rows = slice(stride // 2, None, stride)
        shown_numbers, counts = np.unique(numbers[rows, rows].reshape(-1)[np.asarray(cloud.mask)], return_counts=True)
        for number in shown_numbers[counts >= _FEWEST].tolist():
            if number > 0 and number not in self.objects:
                self.objects[number] = self._session(number, self._box_about(points[numbers == number]))
        require(
            len(self.objects) > 0,
            f"the image shows no object in the box {self.box}: give a box that holds them, in the units of the poses",
        )
        for number, session in self.objects.items():
            corners = np.stack(np.meshgrid(*zip(session.box.low, session.box.high, strict=True)), axis=-1)
            # An image says nothing of what is behind the camera.
            if np.any((corners - np.asarray(pose.position)) @ np.asarray(pose.forward) > 0):
                session.add(depth, matrix, depth_scale, mask=numbers == number)
        self._next = None
        self._mount_error.show(image, self._num_images)
        self._num_images += 1
        self._warned_of_mount = self._warned_of_mount or self._mount_error.warns()

    def next(self) -> Float[np.ndarray, "4 4"]:
        """Where to take the next image: the candidate of most value, in world units and summed over the objects for
        which more are needed. It is the same until an image is added; what was proposed once is not proposed again.

        **Raises:** `ValueError` before the first image, if all candidates were proposed, or as `Planner.propose` does.
        """
        require(len(self.objects) > 0, "there is no image yet: add one first, sessions.add(depth, matrix)")
        if self._next is None:
            open_ones = [session for session in self.objects.values() if session.done() is None]
            total = np.sum([_values(session) for session in open_ones or self.objects.values()], axis=0)
            total[self._proposed] = -np.inf
            require(bool(np.isfinite(total).any()), f"all {len(total)} candidates have been proposed")
            self._next = int(np.argmax(total))
            self._proposed.append(self._next)
        return self._poses[self._next]

    def done(self) -> str | None:
        """Why no more images are needed, by the rule that was given, for any of the objects; None while they are."""
        reasons = {number: session.done() for number, session in self.objects.items()}
        if not reasons or None in reasons.values():
            return None
        return "; ".join(f"{number}: {reason}" for number, reason in reasons.items())

    def _session(self, number: int, box: Box) -> Session:
        """The session of an object, or the stored one if there is a folder of it."""
        folder = None if self._folder is None else self._folder / str(number)
        if folder is not None and folder.exists():
            return Session.load(folder, self._planner, self.until, self._progress)
        return Session(
            self.camera,
            box,
            self._planner,
            self._frame.up,
            self._poses,
            folder,
            key=jax.random.fold_in(self._key, number),
            until=self.until,
            obstacles=self._obstacles,
            correct_mount=None,
            progress=self._progress,
        )

    def _table_of(self, cloud: PointCloud) -> Obstacles:
        """What the objects stand on, in world units; `cloud`: the whole image."""
        table = table_under(self._frame.to_scene(cloud), self._frame.to_scene(self.box))
        if table is None:
            warnings.warn(
                "there is no table under the objects: what they stand on, if it is in the box, is taken for one of "
                "them. Give obstacles=Obstacles((table,)), or Obstacles() if there is none",
                stacklevel=4,
            )
            return Obstacles()
        margin, clearance = (float(self._frame.length_to_world(one)) for one in (table.margin, table.clearance))
        return Obstacles((HalfSpace(*plane_of(table, self._frame)),), margin, clearance)

    def _points(self, image: Image, pose: Pose) -> tuple[Float[np.ndarray, "h w 3"], Bool[np.ndarray, "h w"]]:
        """The point of each pixel, in world units, and which lie in the box and on no obstacle."""
        points = image.points(self.camera, pose)
        depth = (points - np.asarray(pose.position, np.float64)) @ np.asarray(pose.forward, np.float64)
        assert self._obstacles is not None
        is_free = np.asarray(self._obstacles.distance(points)) > self._obstacles.margin
        inside = (depth > max(1e-9, self.camera.nearest)) & (np.asarray(self.box(points)) <= 0) & is_free
        return points, inside

    def _numbers(self, points: Float[np.ndarray, "n 3"]) -> Int[np.ndarray, " n"]:
        """The object that each point is of, by clusters; zero for stray points."""
        owner = np.zeros(len(points), int)
        nearest = np.full(len(points), self._gap)
        for number, session in self.objects.items():
            away, _ = cKDTree(session.cloud.to_numpy()[0]).query(points)
            owner, nearest = np.where(away < nearest, number, owner), np.minimum(nearest, away)
        cluster, last = clusters(points, self._gap), max(self.objects, default=0)
        for one in range(cluster.max(initial=-1) + 1):
            own = np.flatnonzero(cluster == one)
            has_owner = owner[own] > 0
            if has_owner.any():
                _, like = cKDTree(points[own[has_owner]]).query(points[own])
                owner[own] = owner[own[has_owner]][like]
            elif len(own) >= _FEWEST * stride_of(self.camera) ** 2:
                placed = self._on_a_part(points[own])
                last = last + 1 if placed is None else last
                owner[own] = last if placed is None else placed
        return owner

    def _on_a_part(self, points: Float[np.ndarray, "n 3"]) -> int | None:
        """The object on whose likely parts some points lie, within the gap; None if that is none."""
        some = points[np.linspace(0, len(points) - 1, _COMPARED).astype(int)]
        off = {number: _expected_distance(session, some) for number, session in self.objects.items()}
        best = min(off, key=lambda number: off[number], default=None)
        return best if best is not None and off[best] < self._gap else None

    def _box_about(self, points: Float[np.ndarray, "n 3"]) -> Box:
        """A cube that holds an object of which some points were seen: as far beyond them as they reach, though no part
        is longer than the longest. Equal sides, so that all objects run the same programs."""
        low, high = points.min(axis=0), points.max(axis=0)
        reach = float((high - low).max()) + self._gap
        lowest = np.maximum(low - reach, high - self._longest_part)
        highest = np.minimum(high + reach, low + self._longest_part)
        middle, half = 0.5 * (lowest + highest), 0.5 * float((highest - lowest).max())
        return Box(middle - half, middle + half)


def clusters(points: Float[np.ndarray, "n 3"], gap: float) -> Int[np.ndarray, " n"]:
    """Which cluster each point is in: two points that are as near as a gap are in one. Points are taken by cells of a
    quarter of the gap, so that a dense image costs no more than a coarse one."""
    if len(points) == 0:
        return np.zeros(0, int)
    cells, cell = np.unique(np.floor(4.0 * points / gap).astype(np.int64), axis=0, return_inverse=True)
    near = cKDTree(cells).query_pairs(4.0, output_type="ndarray")
    graph = coo_array((np.ones(len(near), bool), (near[:, 0], near[:, 1])), shape=(len(cells), len(cells)))
    return connected_components(graph, directed=False)[1][cell.reshape(-1)]


def _values(session: Session) -> Float[np.ndarray, " candidates"]:
    """What the candidates are worth for one object, in world units; -inf for those that it rules out."""
    planner, key = session.planner, jax.random.fold_in(session.key, len(session.views))
    values = planner.propose(session.observations, key).values
    return np.asarray(session.frame.length_to_world(values, planner.quantity.length_power), np.float64)


def _expected_distance(session: Session, points: Float[np.ndarray, "n 3"]) -> float:
    """The median of the distances of points from an object's surface, in world units: the mean over what it may be."""
    hypotheses, frame = hypotheses_of(session.observations), session.frame
    own = jnp.asarray(frame.to_scene(points), hypotheses.weights.dtype)
    weights = np.asarray(hypotheses.weights, np.float64)[:-1]
    off = np.abs(np.asarray(distances_to(hypotheses, own)[0], np.float64))
    return float(frame.length_to_world(np.median(weights @ off / max(weights.sum(), 1e-30))))
