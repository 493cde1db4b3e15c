"""Sessions for several objects on a table: one session for each object, with the same images."""

import warnings
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int, PRNGKeyArray, Real
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from jaxnbv.checks import AnyArray, InputError, as_numbers, checked, require, short_text
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

# Default gap between objects, as a fraction of the longest side of the box.
_GAP = 0.02
# Smallest number of rays that show an object, and number of a cluster's points that are compared with known parts.
_MIN_RAYS, _NUM_COMPARED = 20, 256


class Sessions:
    """Sessions for several objects, each of which is a known part. Every session gets the same images.

    An object is a cluster of points above the table, or a label in a segmentation of the image.

    - `camera`, `up`, `key`, `until`, `obstacles`, `progress`: as for `Session`.
    - `planner`: planner with known parts and a search over candidates.
    - `box`: two corners of a box around all objects. The box should not contain the table.
    - `gap`: smallest distance between two objects, in world units, at which they can be separated without a
      segmentation. The default is 2 % of the longest side of the box.
    - `folder`: folder with a subfolder for each session. If a subfolder exists, its session continues.

    **Raises:** `ValueError` for a planner without known parts, and whenever `Session` raises it.
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
        # This session checks the arguments, and places the candidates around all objects.
        scene_session = Session(camera, box, planner, up, key=key, until=until, obstacles=obstacles, progress=progress)
        bank = getattr(planner.sampler.model, "bank", None)
        if bank is None or not planner.sampler.model.carries_hypotheses:
            raise InputError("the planner knows no parts: use Planner.for_parts(bank)")
        self.camera, self.box, self.until = camera, box_of(box), until
        self._frame, self._planner, self._key = scene_session.frame, planner, scene_session.key
        self._obstacles, self._progress = obstacles, progress
        self._num_images = 0
        self._mount_error = MountError(camera, scene_session.convention)
        self._longest_part = 2.0 * float(jnp.max(jnp.linalg.norm(bank.shapes.extremes, axis=-1)))
        self._gap = _GAP * float(np.max(self.box.high - self.box.low)) if gap is None else gap
        require(self._gap > 0, f"the gap is {gap}; it must be positive")
        candidates = self._frame.to_world(scene_session.planner.search.poses_around())
        self._poses = np.asarray(candidates.to_matrix(), np.float64)
        self._folder = None if folder is None else Path(folder)
        # Index of the candidate that `next` proposed since the last image, and indices of all proposed candidates.
        self._next: int | None = None
        self._proposed: list[int] = []
        self.objects: dict[int, Session] = {}
        if self._folder is not None:
            numbers = sorted(int(path.name) for path in self._folder.glob("[0-9]*") if path.name.isdigit())
            self.objects = {number: self._session(number, self.box) for number in numbers}

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
        """Add an image to all sessions. A new object gets the next free number and a session.

        - `depth`, `matrix`, `depth_scale`: as for `Session.add`.
        - `labels`: number of the object at each pixel, or zero for no object. An object must have the same number in
          all images. By default, objects are clusters of points above the table. A cluster is part of an earlier object
          if it is within `gap` of this object's points, or of the surface that its probable parts would have.

        **Raises:** `ValueError` if no image so far shows an object, and whenever `Session.add` raises it.
        """
        pixels = as_numbers(depth, "the depth image", None)
        pose = Pose.from_matrix(as_numbers(matrix, "the matrix of a pose", np.float64))
        pixels = without_sentinels(pixels, self.camera, pose, depth_scale, self.box)
        stride = stride_of(self.camera)
        cloud = PointCloud.from_depth(pixels, self.camera, pose, depth_scale, stride)
        if self._obstacles is None:
            self._obstacles = self._table_of(cloud)
        image = Image.from_arrays(pixels, matrix, depth_scale, None)
        points, is_inside = self._points(image, pose)
        if labels is None:
            numbers = np.zeros(pixels.shape, int)
            numbers[is_inside] = self._object_numbers(points[is_inside])
        else:
            numbers = as_numbers(labels, "the labels", None)
            is_valid = numbers.shape == pixels.shape and np.issubdtype(numbers.dtype, np.integer)
            require(
                is_valid, f"the labels are {short_text(labels)}: give whole numbers, one for each of the image's pixels"
            )
        numbers = np.where(is_inside, numbers, 0)
        # The rows and columns of an image that a session uses.
        rows = slice(stride // 2, None, stride)
        shown_numbers, counts = np.unique(numbers[rows, rows].reshape(-1)[np.asarray(cloud.mask)], return_counts=True)
        for number in shown_numbers[counts >= _MIN_RAYS].tolist():
            if number > 0 and number not in self.objects:
                self.objects[number] = self._session(number, self._box_around(points[numbers == number]))
        require(
            len(self.objects) > 0,
            f"the image shows no object in the box {self.box}: give a box that holds them, in the units of the poses",
        )
        for number, session in self.objects.items():
            corners = np.stack(np.meshgrid(*zip(session.box.low, session.box.high, strict=True)), axis=-1)
            # An image has no information about a box behind the camera.
            if np.any((corners - np.asarray(pose.position)) @ np.asarray(pose.forward) > 0):
                session.add(depth, matrix, depth_scale, mask=numbers == number)
        self._next = None
        self._mount_error.add(image, self._num_images)
        self._num_images += 1
        self._mount_error.warn_if_misaligned()

    def next(self) -> Float[np.ndarray, "4 4"]:
        """Return the camera-to-world matrix of the pose for the next image.

        The pose is the candidate with the highest sum of values (world units) over the objects for which the stop rule
        does not hold yet, or over all objects if the rule holds for all. The result stays the same until an image is
        added. No pose is proposed twice.

        **Raises:** `ValueError` before the first image, if all candidates were proposed, and whenever
        `Planner.propose` raises it.
        """
        require(len(self.objects) > 0, "there is no image yet: add one first, sessions.add(depth, matrix)")
        if self._next is None:
            open_sessions = [session for session in self.objects.values() if session.done() is None]
            total = np.sum([_values(session) for session in open_sessions or self.objects.values()], axis=0)
            total[self._proposed] = -np.inf
            require(bool(np.isfinite(total).any()), f"all {len(total)} candidates have been proposed")
            self._next = int(np.argmax(total))
            self._proposed.append(self._next)
        return self._poses[self._next]

    def done(self) -> str | None:
        """Return the reasons to stop if the stop rule holds for all objects; None to continue."""
        reasons = {number: session.done() for number, session in self.objects.items()}
        if not reasons or None in reasons.values():
            return None
        return "; ".join(f"{number}: {reason}" for number, reason in reasons.items())

    def _session(self, number: int, box: Box) -> Session:
        """Load the session of an object from its folder, or create it."""
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
        """Return the table under the objects, in world units. If there is none, warn and return `Obstacles()`."""
        table = table_under(self._frame.to_scene(cloud), self._frame.to_scene(self.box))
        if table is None:
            warnings.warn(
                "there is no table under the objects: if the box contains their support, it counts as an object. Give "
                "obstacles=Obstacles((table,)), or Obstacles() if there is none",
                stacklevel=4,
            )
            return Obstacles()
        margin, clearance = (float(self._frame.length_to_world(length)) for length in (table.margin, table.clearance))
        return Obstacles((HalfSpace(*plane_of(table, self._frame)),), margin, clearance)

    def _points(self, image: Image, pose: Pose) -> tuple[Float[np.ndarray, "h w 3"], Bool[np.ndarray, "h w"]]:
        """Return the world point of each pixel, and a mask of the points in the box that are not on obstacles."""
        points = image.points(self.camera, pose)
        depth = (points - np.asarray(pose.position, np.float64)) @ np.asarray(pose.forward, np.float64)
        assert self._obstacles is not None
        is_free = np.asarray(self._obstacles.distance(points)) > self._obstacles.margin
        is_inside = (depth > max(1e-9, self.camera.nearest)) & (np.asarray(self.box(points)) <= 0) & is_free
        return points, is_inside

    def _object_numbers(self, points: Float[np.ndarray, "n 3"]) -> Int[np.ndarray, " n"]:
        """Return the number of the earlier or new object that each point belongs to; zero for stray points."""
        owner = np.zeros(len(points), int)
        nearest = np.full(len(points), self._gap)
        for number, session in self.objects.items():
            distances, _ = cKDTree(session.cloud.to_numpy()[0]).query(points)
            owner, nearest = np.where(distances < nearest, number, owner), np.minimum(nearest, distances)
        cluster, last_number = clusters(points, self._gap), max(self.objects, default=0)
        for index in range(cluster.max(initial=-1) + 1):
            rows = np.flatnonzero(cluster == index)
            has_owner = owner[rows] > 0
            if has_owner.any():
                _, neighbour = cKDTree(points[rows[has_owner]]).query(points[rows])
                owner[rows] = owner[rows[has_owner]][neighbour]
            elif len(rows) >= _MIN_RAYS * stride_of(self.camera) ** 2:
                part_owner = self._object_near(points[rows])
                last_number = last_number + 1 if part_owner is None else last_number
                owner[rows] = last_number if part_owner is None else part_owner
        return owner

    def _object_near(self, points: Float[np.ndarray, "n 3"]) -> int | None:
        """Return the number of the earlier object to which a cluster belongs; None for a new object.

        The cluster belongs to the object with the smallest expected distance to it, if this distance is below the gap.
        """
        subset = points[np.linspace(0, len(points) - 1, _NUM_COMPARED).astype(int)]
        distances = {number: _expected_distance(session, subset) for number, session in self.objects.items()}
        best = min(distances, key=lambda number: distances[number], default=None)
        return best if best is not None and distances[best] < self._gap else None

    def _box_around(self, points: Float[np.ndarray, "n 3"]) -> Box:
        """Return a cube that contains an object, given some of the object's points.

        On each side, the cube extends beyond the points by their largest extent plus the gap, but only as far as the
        longest part could reach. The sides are equal so that all objects can share the same compiled programs.
        """
        low, high = points.min(axis=0), points.max(axis=0)
        padding = float((high - low).max()) + self._gap
        lowest = np.maximum(low - padding, high - self._longest_part)
        highest = np.minimum(high + padding, low + self._longest_part)
        middle, half = 0.5 * (lowest + highest), 0.5 * float((highest - lowest).max())
        return Box(middle - half, middle + half)


def clusters(points: Float[np.ndarray, "n 3"], gap: float) -> Int[np.ndarray, " n"]:
    """Return the index of each point's cluster. Points less than about `gap` apart share a cluster.

    Distances are between cells whose side is a quarter of the gap, so the cost hardly grows with the density of points.
    """
    if len(points) == 0:
        return np.zeros(0, int)
    cells, cell = np.unique(np.floor(4.0 * points / gap).astype(np.int64), axis=0, return_inverse=True)
    pairs = cKDTree(cells).query_pairs(4.0, output_type="ndarray")
    graph = coo_array((np.ones(len(pairs), bool), (pairs[:, 0], pairs[:, 1])), shape=(len(cells), len(cells)))
    return connected_components(graph, directed=False)[1][cell.reshape(-1)]


def _values(session: Session) -> Float[np.ndarray, " candidates"]:
    """Return the values of the candidates for one object, in world units; -inf for excluded candidates."""
    planner, key = session.planner, jax.random.fold_in(session.key, len(session.views))
    values = planner.propose(session.observations, key).values
    return np.asarray(session.frame.length_to_world(values, planner.quantity.length_power), np.float64)


def _expected_distance(session: Session, points: Float[np.ndarray, "n 3"]) -> float:
    """Return the expected distance of points from the surface of a session's object, in world units.

    The expectation is over the object's hypotheses except "none of these". The result is the median over the points.
    """
    hypotheses, frame = hypotheses_of(session.observations), session.frame
    scene_points = jnp.asarray(frame.to_scene(points), hypotheses.weights.dtype)
    weights = np.asarray(hypotheses.weights, np.float64)[:-1]
    distances = np.abs(np.asarray(distances_to(hypotheses, scene_points), np.float64))
    return float(frame.length_to_world(np.median(weights @ distances / max(weights.sum(), 1e-30))))
