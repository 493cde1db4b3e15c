"""A live session: depth images of a real sensor in, where to take the next one out, in the user's own world."""

import math
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import MappingProxyType
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray, Real
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
from jaxnbv.planning.reachability import Reachable, Refused, best_reachable
from jaxnbv.planning.rehearsal import Rehearsal, rehearse
from jaxnbv.planning.session_folder import SessionFolder
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
from jaxnbv.surfaces.part_hypotheses import hypotheses_of
from jaxnbv.surfaces.part_pose import ObjectPose, object_pose

_NO_UP = 'say which axis of the world is upward, up="z" for most robots: one of'
_NO_IMAGE = "the session has no image yet: add one first, session.add(depth, matrix)"


class NextView(eqx.Module):
    """Where to take the next image.

    - `matrix`: camera to world, in the convention of the session: what to send the camera to. With `correct_mount` it
      is by so much off as the mount is, so that the camera arrives where it should.
    - `value`: what the search maximises, a length or an area in world units; `standard_error`: of the value, as a mean
      over the posterior samples; None for a search that draws fewer than two.
    - `proposal`: all that the search looked at, in scene coordinates.
    - `refusals`: how many poses of more value cannot be reached, by the reason.
    """

    matrix: Float[np.ndarray, "4 4"]
    value: float
    standard_error: float | None
    proposal: Proposal
    refusals: dict[str, int] = eqx.field(default_factory=dict)


class Session:
    """The loop at a real sensor. Matrices are 4 x 4, camera to world, in world units; so is the box. Rules of stopping,
    costs and values are in world units too. Rows and columns of an image are left out evenly, so that 20,000 rays are
    left or fewer; whole images are kept.

    - `camera`: the sensor, its range in world units.
    - `box`: two corners of a box about the object, without the table.
    - `planner`: in scene coordinates, as for a simulation. The scene is the box, scaled; the planner's camera is
      replaced by the sensor's with the planner's number of pixels, and the default volume, `Box()`, by the box. By
      default it looks for `NewSurface`, by a `DiscreteSearch` over eight samples with 24 x 32 rays, and keeps 2,000
      points.
    - `up`: the world's axis that is upward, "y" or "z" say. It must be given, since no default is right for all.
    - `obstacles`: what stands around the object, in world units: `Obstacles((table,), margin=0.005)`, say. By default
      the plane that the object stands on is looked for in the first image, named in a warning, and taken for a table:
      left out of the cloud, and no place for a camera. If there is none a warning says so, and whether there would be
      one by another `up`. Other things outside the box that images show hide the object and keep cameras away,
      coarsely. `Obstacles()` says that there is nothing.
    - `poses`: (n, 4, 4), where the sensor can be held; by default the candidates of the planner's search, in scene
      units about the box's centre, and of a whole sphere the upper half: what is below may be the table. In a room that
      is scanned from inside they must be given: the default ones stand outside the box.
    - `folder`: where images and proposals are kept before they are acted on; a session that was killed goes on from it.
    - `convention`: of the matrices' axes, see `Pose.from_matrix`.
    - `key`: of the posterior samples.
    - `until`: when it is done, such as `Sure(0.95) | Budget(seconds=600)`; see `jaxnbv.planning.stopping`.
    - `correct_mount`: whether poses are corrected by what the images tell of their errors, from the third image on; see
      `alignment`. By default a warning says once that they are off; with None nothing is looked for.
    - `reachable`: a function of matrices (n, 4, 4), in the session's convention, which says of each whether the arm
      can go there: a truth; None if it can, else why not ("joint limit"); or a score from 0 to 1 that the value is
      multiplied by, 1 / (1 + seconds of motion) say. It is asked about the best poses that the search looked at, a few
      at a time, and about those that do not hold with the camera turned about its optical axis too.
    - `ignore`: a function of points (n, 3) in the world, which says of each whether it is of the robot itself: it is
      no part of the object, and hides what is behind it. Asked once about all that an image measured.
    - `progress`: whether a bar shows what it is at while it plans.

    **Raises:** `ValueError` for a box without inside, no `up`, poses that the search has no use for, or a folder of
    another session.
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
        place = self.camera, self.box, self.frame, convention
        self._given_planner = in_scene(planner, *place, matrices, obstacles)
        self._intake = Intake(*place, self._given_planner)
        rays = self.frame.to_scene(self.camera.strided(self._intake.stride))
        self._loop = Loop(self._given_planner, self.key, self.until, self.frame, rays, begin=self._show)
        self._cut: frozenset[str] = frozenset()
        self._next: NextView | None = None
        self.correct_mount, self._warned_of_mount = correct_mount, False
        self.reachable, self.ignore = reachable, ignore
        self._refused: list[Refused] = []
        self._rehearsing = threading.RLock()
        self._folder: SessionFolder | None = None
        if folder is not None:
            # What a session is made of, as it was given: `load` makes it again from these.
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
        """The session of a folder, which goes on from its last image.

        - `planner`: in place of the stored one, where that holds a function or a network that cannot be made again from
          its description; it must have the same description.
        - `until`, `progress`, `reachable`, `ignore`: as of a new session; they are not stored.

        **Raises:** `ValueError` if the folder holds no session, or its planner cannot be made again.
        """
        config = SessionFolder.config_of(path, **({} if planner is None else {"planner": planner}))
        return cls(**config, folder=path, until=until, progress=progress, reachable=reachable, ignore=ignore)

    def __repr__(self) -> str:
        images = f"{len(self.views)} image{'s' * (len(self.views) != 1)}"
        kept = f", {int(self.observations.cloud.count):,} points" if self.views else ""
        proposed = ", the next view proposed" if self.next_view else ""
        return f"Session({self.planner.quantity.name}: {images}{kept}{proposed})"

    def rehearse(self) -> Rehearsal:
        """Compile what the first views run, by images of a ball on a table. It takes half a minute to a minute, or a
        few seconds where programs are kept, see `keep_compiled`. The session stays as it is.

        Call it in a thread while the camera goes to its first pose; images that come before it ends wait for it:
        `threading.Thread(target=session.rehearse).start()`.
        """
        with self._rehearsing:
            intake = Intake(self.camera, self.box, self.frame, self.convention, self._given_planner)
            loop = Loop(self._given_planner, self.key, self.until, self.frame, self._loop.camera)
            return rehearse(intake, loop)

    @property
    def planner(self) -> Planner:
        """The planner at this sensor and box, in scene coordinates."""
        return self._loop.planner

    @property
    def views(self) -> tuple[View, ...]:
        """The images so far, as views of an episode: in scene coordinates."""
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
        """The points in the box that are kept, in world units.

        **Raises:** `ValueError` before the first image.
        """
        cloud = self.frame.to_world(self.observations.cloud)
        return cloud.only(self.box(cloud.points) <= 0)

    @property
    def identity(self) -> dict[str, float]:
        """How likely the object is each of the parts that the planner knows, most likely first, and "none of these".

        **Raises:** `ValueError` before the first image, or if the planner knows no parts.
        """
        return hypotheses_of(self.observations).names()

    @property
    @own_settings()
    def object_pose(self) -> ObjectPose:
        """Where the likeliest part lies in the world.

        **Raises:** `ValueError` as `identity` does.
        """
        return object_pose(hypotheses_of(self.observations), self.observations, self.frame)

    @property
    @own_settings()
    def alignment(self) -> Alignment:
        """How far the images disagree, by the poses as they were given, and which error of the poses explains it. In
        world units.

        **Raises:** `ValueError` for fewer than two images.
        """
        return self._intake.mount_error.alignment()

    @property
    def episode(self) -> Episode:
        """The session so far, as an episode: in scene coordinates, and with the frame in which it is shown.

        **Raises:** `ValueError` before the first image.
        """
        require(len(self.views) > 0, _NO_IMAGE)
        loop, first = self._loop, self.views[0].pose
        return Episode(loop.planner, None, None, first, loop.key, loop.views, loop.stopped, self.frame)

    @own_settings()
    def done(self) -> str | None:
        """Why no more images are needed, by the rule that was given; None while they are. Asked once an image, and
        nothing is stored: the samples and the proposal that a rule asks for are those that `next` gives.

        **Raises:** `ValueError` as `next` does, if the rule is about what comes next.
        """
        with self._planning():
            return self._loop.enough()

    @checked
    def add(
        self,
        depth: Real[AnyArray, "height width"],
        matrix: Float[AnyArray, "4 4"] | list,
        depth_scale: float = 1.0,
        mask: AnyArray | None = None,
    ) -> None:
        """Take in an image, which is stored first. A later image that measured nothing is left out with a
        `UserWarning`.

        - `depth`: see `PointCloud.from_depth`; `depth_scale` times it is in world units: 0.001 for millimetres where
          the world is in metres.
        - `matrix`: where the camera truly was, which need not be what was proposed.
        - `mask`: which pixels show the object, where other things are in the box too, which may hide it; by default
          all that lie in the box.

        **Raises:** `ValueError` as `PointCloud.from_depth`, `Pose.from_matrix`, `Planner.init` and `observe` do, if the
        first image shows nothing of the box, an earlier image is the same bit for bit though its pose is another, or
        another process has added images to the folder. Nothing is changed then.
        """
        image, count = Image.of(depth, matrix, depth_scale, mask), len(self.views)
        if self.ignore is not None:
            # Asked while the robot stands there, and stored.
            image = image.with_robot(self.ignore, self.camera, Pose.from_matrix(image.matrix, self.convention))
        with self._rehearsing, self._alone() as folder:
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
        self._cut = warn_of_cut(self.box, points, voxel, self._cut)
        if self.correct_mount:
            self._correct()
        elif self.correct_mount is not None and not self._warned_of_mount:
            self._warned_of_mount = self._intake.mount_error.warns()

    @own_settings()
    def next(self, seconds: float = math.inf) -> NextView:
        """Where to take the next image. It is stored, and the same until an image is added; what was proposed once is
        not proposed again, for where the sensor could not be held it need not be tried twice. Warns where the best view
        is worth no more than three standard errors and what is expected in vain.

        - `seconds`: how long `reachable` may take, for a motion planner say: then the best pose so far is taken.

        **Raises:** `ValueError` before the first image, as `Planner.propose` does, if no pose can be reached, or if
        another process has added images to the folder.
        """
        if self._next is None:
            with self._alone() as folder, self._planning():
                require(len(self.views) > 0, _NO_IMAGE)
                proposal = self._loop.propose()
                refusals: Mapping[str, int] = {}
                if self.reachable is not None or self._refused:
                    values_at = self._values_at if self._sees_more_turned else None
                    asked = self.reachable, self._matrices, self._refused, values_at, seconds
                    proposal, refusals = best_reachable(proposal, *asked)
                    self._loop.settle(proposal)
                next_view = self._next_of(proposal, refusals)
                warn_of_little(next_view.value, next_view.standard_error, self._in_vain(proposal))
                if folder is not None:
                    folder.store_proposal(len(self.views), proposal)
                self._next = next_view
        return self._next

    @own_settings()
    def expected_depth(self) -> Float[np.ndarray, "h w"] | None:
        """What the sensor is expected to see at the pose that `next` gives, in world units and at the planner's
        resolution: the mean depth over the posterior samples, NaN where most of them are missed; None for a search
        without samples.

        **Raises:** `ValueError` as `next` does.
        """
        proposal, surfaces = self.next().proposal, self._loop.inputs().surfaces
        if surfaces is None:
            return None
        return self.frame.length_to_world(np.asarray(self.planner.expected_depth(surfaces, proposal.pose)))

    def refuse(self, reason: str = "refused") -> None:
        """Say that the camera cannot be held where `next` asks for it: the next call gives the best other pose, at once
        from the same samples, and this one is not proposed again. It is not counted as a place where the camera was.

        **Raises:** `ValueError` if `next` was not asked since the last image.
        """
        if self._next is None:
            raise InputError("there is no proposal to refuse: ask session.next() first")
        refused = Refused(self._next.proposal.pose, reason)
        with self._alone() as folder:
            if folder is not None:
                folder.store_refused(len(self.views), refused)
            self._refused.append(refused)
            self._next = None

    @property
    def next_view(self) -> NextView | None:
        """What `next` gave since the last image; None where it was not asked yet."""
        return self._next

    def _add(self, image: Image, accepted: Callable[[], None] = lambda: None) -> None:
        """Add a view, unless the image is blank."""
        if (loop := self._intake.add(self._loop, image, accepted)) is not None:
            self._loop, self._next = loop, None

    def _correct(self) -> None:
        """Add the images again where they tell that cameras were elsewhere."""
        if not self._intake.mount_error.update():
            return
        images, views = self._intake.images, self.views
        self._loop, self._intake = self._loop.emptied(self._given_planner), self._intake.emptied()
        for image, view in zip(images, views, strict=True):
            if view.proposal is not None:
                self._loop.resume(view.proposal)
            self._add(image)

    def _read(self, folder: SessionFolder) -> None:
        """The images of the folder and the proposals that they followed; the proposal after the last one."""
        self._refused, count = folder.refused(), folder.num_images
        for index in range(count + 1):
            if index and (stored := folder.proposal(index)) is not None:
                self._loop.resume(stored)
                self._next = self._next_of(stored)
            if index < count:
                self._add(folder.image(index))
                if self.correct_mount:
                    self._correct()

    def _next_of(self, proposal: Proposal, refusals: Mapping[str, int] = MappingProxyType({})) -> NextView:
        """A proposal in the user's world."""
        error = None if proposal.standard_error is None else self._loop.in_world(proposal.standard_error)
        error = error if error is not None and math.isfinite(error) else None
        (matrix,), value = self._matrices(proposal.pose[None]), self._loop.in_world(proposal.value)
        return NextView(matrix, value, error, proposal, dict(refusals))

    def _matrices(self, poses: Pose) -> Float[np.ndarray, "n 4 4"]:
        """What to send the camera to for it to stand at poses of the scene."""
        sent = self._intake.mount_error.sent(self.frame.to_world(poses))
        return np.asarray(sent.to_matrix(self.convention), np.float64)

    @property
    def _sees_more_turned(self) -> bool:
        """Whether the planner's image shows something else if the camera is turned about its optical axis."""
        camera = self.planner.camera
        return self.planner.search.uses_samples and camera.height != camera.width

    def _values_at(self, poses: Pose) -> Float[Array, " n"]:
        return self.planner.values_at(self._loop.inputs(), poses)

    def _in_vain(self, proposal: Proposal) -> float:
        return 0.0 if proposal.in_vain is None else self._loop.in_world(proposal.in_vain)

    def _show(self, stage: str) -> None:
        """The stage on the bar, which begins with the first one."""
        if self._bar is None:
            self._bar = progress_bar(total=2, wanted=self.progress)
        self._bar.set_description(f"view {len(self.views) + 1}, {stage}")
        self._bar.update(STAGES.index(stage) - self._bar.n)

    @contextmanager
    def _planning(self) -> Iterator[None]:
        """While a bar shows the stages of planning, if there are any."""
        try:
            yield
        finally:
            if self._bar is not None:
                self._bar.close()
            self._bar = None

    @contextmanager
    def _alone(self) -> Iterator[SessionFolder | None]:
        """The folder, if there is one, while nobody else writes there.

        **Raises:** `ValueError` if another process does, or has added images.
        """
        if self._folder is None:
            yield None
            return
        with self._folder.writing(len(self.views)):
            yield self._folder
