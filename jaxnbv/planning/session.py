"""Live sessions, which take images from a real sensor and return the camera's next pose."""

import math
import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float, PRNGKeyArray, Real
from tqdm import tqdm

from jaxnbv.checks import AnyArray, InputError, as_numbers, check_key, checked, own_settings, require
from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.frame import AXES, Frame
from jaxnbv.geometry.pose import Pose
from jaxnbv.geometry.volume import Box
from jaxnbv.observations import Observations
from jaxnbv.planning.alignment import Alignment
from jaxnbv.planning.episode import Episode
from jaxnbv.planning.images import Ignore, Image
from jaxnbv.planning.intake import Intake
from jaxnbv.planning.loop import STAGES, Loop, View
from jaxnbv.planning.planner import Planner
from jaxnbv.planning.reachability import Reachable, RefusedPose, best_reachable
from jaxnbv.planning.rehearsal import Rehearsal, rehearse
from jaxnbv.planning.session_folder import KIND, SessionFolder
from jaxnbv.planning.session_scene import box_of, in_scene, usual_planner
from jaxnbv.planning.session_warnings import (
    warn_of_blank,
    warn_of_cut,
    warn_of_inside,
    warn_of_little,
    warn_of_no_table,
    warn_of_table,
)
from jaxnbv.planning.stopping import StopRule
from jaxnbv.progress import progress_bar
from jaxnbv.scanning import Obstacles
from jaxnbv.search import Proposal
from jaxnbv.storage import RunFolder
from jaxnbv.surfaces.part_hypotheses import hypotheses_of
from jaxnbv.surfaces.part_pose import ObjectPose, object_pose

_NO_UP = 'say which axis of the world is upward, up="z" for most robots: one of'
_NO_IMAGE = "the session has no image yet: add one first, session.add(depth, matrix)"


class NextView(eqx.Module):
    """The proposed pose for the next image.

    - `matrix`: camera-to-world matrix of the pose to command, in the session's convention. With `correct_mount`, the
      matrix compensates for the error of the camera's mount.
    - `value`: value that the search gave the pose, in world units.
    - `standard_error`: standard error of the value as a mean over posterior samples; None with fewer than two samples.
    - `proposal`: result of the search, in scene coordinates.
    - `refusals`: for each reason, the number of poses that were tried but cannot be reached.
    """

    matrix: Float[np.ndarray, "4 4"]
    value: float
    standard_error: float | None
    proposal: Proposal
    refusals: dict[str, int] = eqx.field(default_factory=dict)


class Session:
    """The planning loop at a real sensor.

    Matrices (4 x 4, camera to world), the box, stop rules, costs and values are in world units. Planning uses evenly
    spaced rows and columns of each image, at most 20,000 rays. The folder stores whole images.

    - `camera`: the sensor, with its range in world units.
    - `box`: two corners of a box around the object. The box should not contain the table.
    - `planner`: a planner in scene coordinates, as for a simulation. The scene is the scaled box. The sensor's camera
      replaces the planner's camera, at the planner's resolution. The box replaces the default volume `Box()` of the
      carving. The default planner uses `NewSurface`, `DiscreteSearch`, eight samples, 24 x 32 rays and 2,000 points.
    - `up`: the world's upward axis, for example "z". Required, because no default is right for all robots.
    - `obstacles`: solids around the object, in world units, for example `Obstacles((table,), margin=0.005)`. Pass
      `Obstacles()` if there are none. By default the session detects obstacles:

      - A plane under the object in the first image counts as a table. A warning describes it, its points are removed,
        and cameras keep clear of it. If no table is found, a warning names values of `up` that would give one.
      - Surfaces outside the box become coarse obstacles. They may hide the object, and cameras keep clear of them.

    - `poses`: (n, 4, 4), poses at which the sensor can be held. The default is the candidates of the planner's search,
      in scene units around the centre of the box. If these are a whole sphere, only its upper half is used, because a
      table may be below. Give poses to scan a room from inside, because the default poses are outside the box.
    - `folder`: folder in which images and proposals are stored before they are used. A session whose process was killed
      continues from this folder.
    - `convention`: axes of the matrices, see `Pose.from_matrix`.
    - `key`: random key of the posterior samples.
    - `until`: stop rule, for example `Sure(0.95) | Budget(seconds=600)`; see `jaxnbv.planning.stopping`.
    - `correct_mount`: True corrects the poses from the third image on, by the errors that `alignment` estimates. False
      warns once if the poses seem wrong. None skips the check.
    - `reachable`: function of matrices (n, 4, 4) in the session's convention that returns, for each matrix, whether the
      arm can go there, see `jaxnbv.planning.reachability.Reachable`. A score from 0 to 1 multiplies the value of the
      pose, for example 1 / (1 + seconds of motion). The function is called with batches of poses in the order of their
      value. If a pose cannot be reached, the session tries it with the camera rotated about its optical axis.
    - `ignore`: function of world points (n, 3) that returns, for each point, whether it belongs to the robot. Points of
      the robot are not part of the object, but hide the space behind them. The function is called once for each image,
      with all measured points.
    - `progress`: whether to show the stages of planning on a progress bar.

    **Raises:** `ValueError` for an empty box, a missing `up`, poses that the search cannot use, or a folder whose
    session has different arguments.
    """

    @checked
    def __init__(
        self,
        camera: Camera,
        box: tuple | list | Box | AnyArray,
        planner: Planner | None = None,
        up: str | None = None,
        poses: Float[AnyArray, "n 4 4"] | None = None,
        folder: str | Path | None = None,
        convention: str = "opencv",
        key: PRNGKeyArray | None = None,
        until: StopRule | None = None,
        obstacles: Obstacles | None = None,
        correct_mount: bool | None = False,
        reachable: Reachable | None = None,
        ignore: Ignore | None = None,
        progress: bool = True,
    ):
        self.camera, self.box, self.convention = camera, box_of(box), convention
        self.key, self.until, self.progress = jax.random.key(0) if key is None else key, until, progress
        check_key(self.key)
        if up is None:
            raise InputError(f"{_NO_UP} {', '.join(AXES)}")
        self.frame = Frame.fit(np.array([self.box.low, self.box.high]), up=up)
        planner = usual_planner() if planner is None else planner
        matrices = None if poses is None else as_numbers(poses, "the poses", np.float64)
        self._bar: tqdm[Any] | None = None
        setup = self.camera, self.box, self.frame, convention
        self._initial_planner = in_scene(planner, *setup, matrices, obstacles)
        self._intake = Intake(*setup, self._initial_planner)
        strided_camera = self.frame.to_scene(self.camera.strided(self._intake.stride))
        self._loop = Loop(self._initial_planner, self.key, until, self.frame, strided_camera, self._show_stage)
        self._cut_faces: frozenset[str] = frozenset()
        self._next: NextView | None = None
        self.correct_mount, self.reachable, self.ignore = correct_mount, reachable, ignore
        self._refused_poses: list[RefusedPose] = []
        self._rehearsal_lock = threading.RLock()
        self._folder: SessionFolder | None = None
        if folder is not None:
            # `load` passes these arguments to the new session.
            config = {"camera": camera, "box": self.box, "planner": planner, "up": up, "poses": matrices}
            config |= {"convention": convention, "key": self.key, "obstacles": obstacles}
            config |= {"correct_mount": correct_mount}
            self._folder = SessionFolder(folder, config)
            self._read(self._folder)

    @classmethod
    def load(
        cls,
        path: str | Path,
        planner: Planner | None = None,
        until: StopRule | None = None,
        progress: bool = True,
        reachable: Reachable | None = None,
        ignore: Ignore | None = None,
    ) -> "Session":
        """Load a session from its folder, to continue after its last image.

        - `planner`: planner to use if the stored one contains a function or network that cannot be restored. Both must
          have the same description.
        - `until`, `progress`, `reachable`, `ignore`: as for a new session. The folder does not store them.

        **Raises:** `ValueError` if the folder holds no session, or if the stored planner cannot be restored.
        """
        config = RunFolder.config_of(path, KIND, **({} if planner is None else {"planner": planner}))
        return cls(**config, folder=path, until=until, progress=progress, reachable=reachable, ignore=ignore)

    def __repr__(self) -> str:
        images = f"{len(self.views)} image{'s' * (len(self.views) != 1)}"
        points = f", {int(self.observations.cloud.count):,} points" if self.views else ""
        next_view = ", the next view proposed" if self.next_view else ""
        return f"Session({self.planner.quantity.name}: {images}{points}{next_view})"

    def rehearse(self) -> Rehearsal:
        """Compile the programs of the first views, by planning with simulated images of a ball on a table.

        This takes half a minute to a minute, or a few seconds if compiled programs are cached (see `keep_compiled`).
        The session does not change. To rehearse while the camera moves to its first pose, call
        `threading.Thread(target=session.rehearse).start()`. `add` waits until the rehearsal has ended.
        """
        with self._rehearsal_lock:
            intake = Intake(self.camera, self.box, self.frame, self.convention, self._initial_planner)
            loop = Loop(self._initial_planner, self.key, self.until, self.frame, self._loop.camera)
            return rehearse(intake, loop)

    @property
    def planner(self) -> Planner:
        """The planner for this sensor and box, in scene coordinates."""
        return self._loop.planner

    @property
    def views(self) -> tuple[View, ...]:
        """The images so far, as views of an episode in scene coordinates."""
        return self._loop.views

    @property
    def observations(self) -> Observations:
        """The planner's observations, in scene coordinates.

        **Raises:** `ValueError` before the first image.
        """
        require(len(self.views) > 0, _NO_IMAGE)
        return self._loop.observations

    @property
    @own_settings()
    def cloud(self) -> PointCloud:
        """The points of the observations that lie in the box, in world units.

        **Raises:** `ValueError` before the first image.
        """
        cloud = self.frame.to_world(self.observations.cloud)
        return cloud.only(self.box(cloud.points) <= 0)

    @property
    def identity(self) -> dict[str, float]:
        """Probability of each known part and of "none of these", the largest first.

        **Raises:** `ValueError` before the first image, or if the planner has no known parts.
        """
        return hypotheses_of(self.observations).names()

    @property
    @own_settings()
    def object_pose(self) -> ObjectPose:
        """World pose of the most probable part, at its most probable placement.

        **Raises:** `ValueError` before the first image, or if the planner has no known parts.
        """
        return object_pose(hypotheses_of(self.observations), self.observations, self.frame)

    @property
    @own_settings()
    def alignment(self) -> Alignment:
        """Disagreement of the images, and the pose errors that explain it, in world units.

        **Raises:** `ValueError` for fewer than two images.
        """
        return self._intake.mount_error.alignment()

    @property
    def episode(self) -> Episode:
        """The session so far as an episode in scene coordinates, whose `frame` maps the world to the scene.

        **Raises:** `ValueError` before the first image.
        """
        require(len(self.views) > 0, _NO_IMAGE)
        loop, first = self._loop, self.views[0].pose
        return Episode(loop.planner, None, None, first, loop.key, loop.views, loop.stop_reason, self.frame)

    @own_settings()
    def done(self) -> str | None:
        """Return the stop rule's reason to stop; None to continue.

        The rule is evaluated once for each image. `next` reuses the samples and the proposal that the rule computed.
        Nothing is stored in the folder.

        **Raises:** `ValueError` if the rule needs the next proposal and `next` raises it.
        """
        with self._planning():
            return self._loop.done()

    @checked
    def add(
        self,
        depth: Real[AnyArray, "height width"],
        matrix: Float[AnyArray, "4 4"] | list,
        depth_scale: float = 1.0,
        mask: AnyArray | None = None,
    ) -> None:
        """Store an image in the folder, and add it to the session.

        An image without a measurement is left out with a `UserWarning`, unless it is the first image.

        - `depth`: depth image, see `PointCloud.from_depth`.
        - `matrix`: actual pose of the camera, camera to world. It may differ from the proposed pose.
        - `depth_scale`: factor from depth to world units: 0.001 for millimetres in a world in metres.
        - `mask`: mask of the pixels that show the object. Give a mask if other things in the box may hide the object.
          By default all points in the box belong to the object.

        **Raises:** `ValueError` in the following cases. The session does not change then.

        - `PointCloud.from_depth`, `Pose.from_matrix`, `Planner.init` or `Planner.observe` raises it.
        - The first image shows nothing of the box.
        - The image is identical to an earlier image that has a different pose.
        - A different process has added images to the folder.
        """
        image, count = Image.from_arrays(depth, matrix, depth_scale, mask), len(self.views)
        if self.ignore is not None:
            # `ignore` is called now, while the robot is still at this pose. The image stores the result.
            image = image.with_robot(self.ignore, self.camera, Pose.from_matrix(image.matrix, self.convention))
        with self._rehearsal_lock, self._lock_folder() as folder:
            looks_for_table = count == 0 and self.planner.obstacles is None
            self._add(image, lambda: None if folder is None else folder.store_image(count, image))
        if len(self.views) == count:
            warn_of_blank()
            return
        if looks_for_table and self._intake.table is not None:
            warn_of_table(self._intake.table, self.frame)
        elif looks_for_table:
            warn_of_no_table(self.frame.up, self._intake.other_ups)
        cameras = np.stack([np.asarray(self.frame.to_world(view.pose).position) for view in self.views])
        candidates = self.frame.to_world(self.planner.search.poses_around()).position
        warn_of_inside(self.box, cameras, np.asarray(candidates))
        voxel = self.frame.length_to_world(self.planner.sampler.grid.spacing)
        points, _ = self.frame.to_world(self.observations.cloud).to_numpy()
        self._cut_faces = warn_of_cut(self.box, points, voxel, self._cut_faces)
        if self.correct_mount:
            self._correct()
        elif self.correct_mount is not None:
            self._intake.mount_error.warn_if_misaligned()

    @own_settings()
    def next(self, seconds: float = math.inf) -> NextView:
        """Propose the pose for the next image.

        The result is stored in the folder, and stays the same until an image is added. After that the pose is not
        proposed again, even if the image was taken from a different pose. The method warns if the pose may show nothing
        new: if its value is at most three standard errors above the mean value of the visited poses, which can show
        nothing new.

        - `seconds`: time limit for calls of `reachable`. After this time, the best reachable pose so far is used.

        **Raises:** `ValueError` before the first image, if no pose can be reached, if a different process has added
        images to the folder, and whenever `Planner.propose` raises it.
        """
        if self._next is None:
            with self._lock_folder() as folder, self._planning():
                require(len(self.views) > 0, _NO_IMAGE)
                proposal, refusals = best_reachable(
                    self._loop, self.reachable, self._matrices, self._refused_poses, seconds
                )
                next_view = self._to_next_view(proposal, refusals)
                at_visited = proposal.value_at_visited
                value_at_visited = 0.0 if at_visited is None else self._loop.in_world(at_visited)
                warn_of_little(next_view.value, next_view.standard_error, value_at_visited)
                if folder is not None:
                    folder.store_proposal(len(self.views), proposal)
                self._next = next_view
        return self._next

    @own_settings()
    def expected_depth(self) -> Float[np.ndarray, "h w"] | None:
        """Return the expected depth image at the pose of `next`, in world units.

        The image has the resolution of the planner's camera. A pixel is the mean depth over the posterior samples, or
        NaN if the ray misses most samples. Return None if the search uses no samples.

        **Raises:** `ValueError` whenever `next` raises it.
        """
        proposal, surfaces = self.next().proposal, self._loop.inputs().surfaces
        if surfaces is None:
            return None
        return self.frame.length_to_world(np.asarray(self.planner.expected_depth(surfaces, proposal.pose)))

    def refuse(self, reason: str = "refused") -> None:
        """Refuse the pose that `next` returned, for example because the camera cannot be held there.

        The pose is not proposed again, and does not count as visited. `next` then returns the best remaining pose
        without a new search.

        - `reason`: text that `NextView.refusals` uses for this pose from now on.

        **Raises:** `ValueError` if `next` was not called since the last image.
        """
        if self._next is None:
            raise InputError("there is no proposal to refuse: ask session.next() first")
        refused = RefusedPose(self._next.proposal.pose, reason)
        with self._lock_folder() as folder:
            if folder is not None:
                folder.store_refused_pose(len(self.views), refused)
            self._refused_poses.append(refused)
            self._next = None

    @property
    def next_view(self) -> NextView | None:
        """Result of `next` since the last image; None if `next` was not called."""
        return self._next

    def _add(self, image: Image, on_accept: Callable[[], None] = lambda: None) -> None:
        """Add an image as a view, unless it is blank. `on_accept`: see `Intake.add`."""
        if (loop := self._intake.add(self._loop, image, on_accept)) is not None:
            self._loop, self._next = loop, None

    def _correct(self) -> None:
        """Estimate the pose errors from the images so far. If corrections changed, add all images again."""
        if not self._intake.mount_error.update():
            return
        images, views = self._intake.images, self.views
        self._loop, self._intake = self._loop.without_views(self._initial_planner), self._intake.without_images()
        for image, view in zip(images, views, strict=True):
            if view.proposal is not None:
                self._loop.set_stored_proposal(view.proposal)
            self._add(image)

    def _read(self, folder: SessionFolder) -> None:
        """Add the folder's images and their proposals to the session. Restore the proposal for the next image."""
        self._refused_poses, count = folder.refused_poses(), folder.num_images
        for index in range(count + 1):
            if index and (proposal := folder.proposal(index)) is not None:
                self._loop.set_stored_proposal(proposal)
                self._next = self._to_next_view(proposal, {})
            if index < count:
                self._add(folder.image(index))
                if self.correct_mount:
                    self._correct()

    def _to_next_view(self, proposal: Proposal, refusals: dict[str, int]) -> NextView:
        error = None if proposal.standard_error is None else self._loop.in_world(proposal.standard_error)
        error = error if error is not None and math.isfinite(error) else None
        (matrix,), value = self._matrices(proposal.pose[None]), self._loop.in_world(proposal.value)
        return NextView(matrix, value, error, proposal, refusals)

    def _matrices(self, poses: Pose) -> Float[np.ndarray, "n 4 4"]:
        """Return the world matrices to command so that the camera arrives at scene poses (n,)."""
        commanded_poses = self._intake.mount_error.command_poses(self.frame.to_world(poses))
        return np.asarray(commanded_poses.to_matrix(self.convention), np.float64)

    def _show_stage(self, stage: str) -> None:
        """Show a stage of planning on the progress bar. The first call creates the bar."""
        if self._bar is None:
            self._bar = progress_bar(total=2, enabled=self.progress)
        self._bar.set_description(f"view {len(self.views) + 1}, {stage}")
        self._bar.update(STAGES.index(stage) - self._bar.n)

    @contextmanager
    def _planning(self) -> Iterator[None]:
        """Context manager: close the progress bar at the end of the block."""
        try:
            yield
        finally:
            if self._bar is not None:
                self._bar.close()
            self._bar = None

    def _lock_folder(self) -> AbstractContextManager[SessionFolder | None]:
        """Context manager: lock the folder for writing, and yield it, or None if the session has no folder."""
        return nullcontext() if self._folder is None else self._folder.writing(len(self.views))
