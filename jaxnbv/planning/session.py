"""A live session: depth images of a real sensor in, where to take the next one out, in the user's own world."""

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float, PRNGKeyArray, Real

from jaxnbv.checks import AnyArray, InputError, as_numbers, check_key, checked, require
from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.depth_image import NothingInside
from jaxnbv.geometry.frame import Frame
from jaxnbv.geometry.pose import Pose
from jaxnbv.geometry.volume import Box
from jaxnbv.observations import Observations
from jaxnbv.planning.episode import STAGES, Episode, View, view_keys
from jaxnbv.planning.placing import box_of, on_support, placed, stride_of, usual_planner
from jaxnbv.planning.planner import Planner
from jaxnbv.planning.stopping import Watch
from jaxnbv.progress import progress_bar
from jaxnbv.scanning import Obstacles, plane_under
from jaxnbv.search import Proposal
from jaxnbv.storage import RunFolder
from jaxnbv.tasks import StopRule

_NO_IMAGE = "the session has no image yet: add one first, session.add(depth, matrix)"


class NextView(eqx.Module):
    """Where to take the next image.

    - `matrix`: camera to world, in the convention of the session.
    - `value`: what the search maximises, a length or an area in world units; `standard_error`: of the value, as a mean
      over the posterior samples; None where it is not known.
    - `expected_depth`: what the sensor is expected to see there, in world units and at the planner's resolution: the
      mean depth over the posterior samples, NaN where most of them are missed; None without samples.
    - `proposal`: all that the search looked at, in scene coordinates.
    """

    matrix: Float[np.ndarray, "4 4"]
    value: float
    standard_error: float | None
    expected_depth: Float[np.ndarray, "h w"] | None
    proposal: Proposal


class Session:
    """A planner at a real sensor. Matrices are 4 x 4, camera to world, in world units; so is the box. Of an image every
    so many-th row and column is used, such that 20,000 rays are left or fewer; whole images are kept.

    - `camera`: the sensor, its range in world units.
    - `box`: two corners of a box about the object, without the table.
    - `planner`: in scene coordinates, as for a simulation. The scene is the box, scaled; the planner's camera is
      replaced by the sensor's with the planner's number of pixels, and what it holds for the default volume, `Box()`,
      by the box. By default it looks for `NewSurface`, by a `HalvingSearch` with 24 x 32 rays, and keeps 2,000 points.
    - `up`: the world's axis that is upward, "y" or "z" say.
    - `obstacles`: what stands around the object, in world units: `Obstacles((table,), margin=0.005)`, say. By
      default the plane that the object stands on is looked for in the first image, told of by a warning, and taken for
      a table: left out of the cloud, and no place for a camera. `Obstacles()` says that there is none.
    - `poses`: (n, 4, 4), where the sensor can be held; by default the candidates of the planner's search, in scene
      units about the box's centre, and of a whole sphere the upper half: what is below may be the table.
    - `folder`: where images and proposals are kept before they are acted on; a session that was killed goes on from it.
    - `convention`: of the matrices' axes, see `Pose.from_matrix`.
    - `key`: of the posterior samples.
    - `until`: when it is done, such as `Sure(0.95) | Budget(seconds=600)`; see `jaxnbv.planning.stopping`.
    - `progress`: whether a bar shows what it is at while it plans.

    **Raises:** `ValueError` for a box without inside, poses that the search has no use for, or a folder of another
    session.
    """

    @checked
    def __init__(
        self,
        camera: Camera,
        box: tuple | list | Box | AnyArray,
        planner: Planner | None = None,
        up: str = "y",
        poses: Float[AnyArray, "n 4 4"] | None = None,
        folder: str | Path | None = None,
        convention: str = "opencv",
        key: PRNGKeyArray | None = None,
        until: StopRule | None = None,
        obstacles: Obstacles | None = None,
        progress: bool = True,
    ):
        self.camera, self.convention = camera, convention
        self.box = box_of(box)
        self.frame = Frame.fit(np.array([self.box.low, self.box.high]), up=up)
        self.stride, self.progress = stride_of(camera), progress
        self.key = jax.random.key(0) if key is None else key
        check_key(self.key)
        allowed = None if poses is None else self.frame.to_scene(Pose.from_matrix(poses, convention))
        sensor, volume = self.frame.to_scene(camera), self.frame.to_scene(self.box)
        around = None if obstacles is None else obstacles.in_scene(self.frame)
        self.planner = placed(usual_planner() if planner is None else planner, sensor, volume, allowed, around)
        self._rays = self.frame.to_scene(camera.strided(self.stride))
        self._watch, self._asked_at = None if until is None else Watch(until, self.planner.acquisition), 0
        self._views: list[View] = []
        self._proposals: dict[int, Proposal] = {}
        self._next: NextView | None = None
        self._evidence: Observations | None = None
        self._folder = None if folder is None else RunFolder(folder, "session", self._config())
        if self._folder is not None:
            for index in range(self._folder.count("image")):
                if self._folder.file("proposal", index).exists():
                    self._proposals[index] = self._folder.read("proposal", index)["proposal"]
                image = self._folder.read("image", index)
                self._take(*self._looked(image["depth"], image["matrix"], float(image["depth_scale"])))

    def __repr__(self) -> str:
        images = f"{self.views} image{'s' * (self.views != 1)}"
        kept = f", {int(self.observations.cloud.count):,} points" if self.views else ""
        asked = ", the next view proposed" if self.next_view else ""
        return f"Session({self.planner.quantity.name}: {images}{kept}{asked})"

    @property
    def views(self) -> int:
        """How many images there are so far."""
        return len(self._views)

    @property
    def observations(self) -> Observations:
        """What the planner knows, in scene coordinates.

        **Raises:** `ValueError` before the first image.
        """
        if self._evidence is None:
            raise InputError(_NO_IMAGE)
        return self._evidence

    @property
    def cloud(self) -> PointCloud:
        """The points that are kept, in world units.

        **Raises:** `ValueError` before the first image.
        """
        return self.frame.to_world(self.observations.cloud)

    @property
    def episode(self) -> Episode:
        """The session so far, in scene coordinates, as of a simulation.

        **Raises:** `ValueError` before the first image.
        """
        require(self.views > 0, _NO_IMAGE)
        return Episode(self.planner, None, None, self._views[0].pose, self.key, tuple(self._views))

    @property
    def done(self) -> str | None:
        """Why no more images are needed, by the rule that was given; None while they are. Asked once an image.

        **Raises:** `ValueError` as `next` does, if the rule is about what comes next.
        """
        if self._watch is None or not self._views:
            return None
        if self._asked_at < self.views:
            key, *_ = view_keys(self.key, self.views)
            poses = [view.pose for view in self._views]
            known = self.planner, self.observations, poses, key
            if not self._watch.ends(*known) and self._watch.rule.needs_proposal:
                self._watch.ends(*known, self.next().proposal)
            self._asked_at = self.views
        return self._watch.reason

    @checked
    def add(
        self,
        depth: Real[AnyArray, "height width"],
        matrix: Float[AnyArray, "4 4"] | list,
        depth_scale: float = 1.0,
    ) -> None:
        """Take in an image, which is stored first.

        - `depth`: see `PointCloud.from_depth`; `depth_scale` times it is in world units: 0.001 for millimetres where
          the world is in metres.
        - `matrix`: where the camera truly was, which need not be what was proposed.

        **Raises:** `ValueError` as `PointCloud.from_depth`, `Pose.from_matrix`, `Planner.init` and `observe` do, if the
        first image shows nothing of the box, or if another process has added images to the folder. Nothing is changed
        then.
        """
        pixels = as_numbers(depth, "the depth image", None)
        place = as_numbers(matrix, "the matrix of a pose", np.float64)
        look = self._looked(pixels, place, depth_scale)
        with self._alone() as folder:
            if folder is not None:
                folder.write("image", self.views, depth=pixels, matrix=place, depth_scale=depth_scale)
        self._take(*look)

    def next(self) -> NextView:
        """Where to take the next image. It is stored, and the same until an image is added; what was proposed once is
        not proposed again, for where the sensor could not be held it need not be tried twice. Warns where the best view
        is worth no more than three standard errors.

        **Raises:** `ValueError` before the first image, as `Planner.propose` does, or if another process has added
        images to the folder.
        """
        if self._next is None:
            index = self.views
            with self._alone() as folder:
                if folder is not None and folder.file("proposal", index).exists():
                    found = folder.read("proposal", index)
                else:
                    found = self._propose()
                    if folder is not None:
                        folder.write("proposal", index, **found)
            self._proposals[index] = proposal = found["proposal"]
            matrix = np.asarray(self.frame.to_world(proposal.pose).to_matrix(self.convention), np.float64)
            unit, error = self.frame.scale**self.planner.quantity.length_power, proposal.standard_error
            value, error = float(proposal.value) / unit, None if error is None else error / unit
            self._next = NextView(matrix, value, error, found.get("expected_depth"), proposal)
        return self._next

    @property
    def next_view(self) -> NextView | None:
        """What `next` gave since the last image; None where it was not asked yet."""
        return self._next

    def _config(self) -> dict:
        sensor = {"camera": self.camera, "box": self.box, "up": self.frame.up, "convention": self.convention}
        return {**sensor, "key": self.key, "planner": self.planner}

    def _looked(
        self, depth: Real[np.ndarray, "h w"], matrix: Float[np.ndarray, "4 4"], depth_scale: float
    ) -> tuple[Planner, View, Observations]:
        """An image as a view, and what is known after it; nothing of the session is changed. The first may show what
        the object stands on, by which the planner is another."""
        pose, planner, rays = Pose.from_matrix(matrix, self.convention), self.planner, self._rays
        shown = depth, self.camera, pose, depth_scale, self.stride
        with warnings.catch_warnings():
            if not self._views:
                warnings.simplefilter("error", NothingInside)
            try:
                cloud = PointCloud.from_depth(*shown, self.box)
            except NothingInside as problem:
                raise InputError(f"the first image shows nothing of the box: {problem}") from problem
        if not self._views and planner.sampler.obstacles is None:
            whole = self.frame.to_scene(PointCloud.from_depth(*shown))
            planner = on_support(planner, plane_under(whole, self.frame.to_scene(self.box)), self.frame)
        scan = self.frame.to_scene(cloud)
        if (around := planner.sampler.obstacles) is not None:
            scan = around.remove_points(scan)
        told = self.frame.to_scene(pose), scan, rays
        observations = planner.init(*told) if self._evidence is None else planner.observe(self._evidence, *told)
        return planner, View(told[0], scan, observations.cloud, self._proposals.get(self.views), rays), observations

    def _take(self, planner: Planner, view: View, observations: Observations) -> None:
        self.planner, self._evidence = planner, observations
        self._views.append(view)
        self._next = None

    def _propose(self) -> dict[str, Any]:
        """The next proposal, and the depth image that is expected there, in world units."""
        sample_key, search_key, _ = view_keys(self.key, self.views)
        proposed = [proposal.pose for index, proposal in sorted(self._proposals.items()) if index < self.views]
        expected = None
        with progress_bar(total=2, wanted=self.progress) as bar:
            bar.set_description(f"view {self.views + 1}, {STAGES[0]}")
            surfaces = jax.block_until_ready(self.planner.sample(self.observations, sample_key))
            bar.update()
            bar.set_description(f"view {self.views + 1}, {STAGES[1]}")
            proposal = self.planner.choose(self.observations.with_visited(proposed), surfaces, search_key)
            if surfaces is not None:
                expected = np.asarray(self.planner.expected_depth(surfaces, proposal.pose)) / self.frame.scale
            bar.update()
        _warn_of_little(proposal)
        return {"proposal": proposal, "expected_depth": expected}

    @contextmanager
    def _alone(self) -> Iterator[RunFolder | None]:
        """The folder, if there is one, while nobody else writes there.

        **Raises:** `ValueError` if another process does, or has added images.
        """
        if self._folder is None:
            yield None
            return
        with self._folder.writing():
            found = self._folder.count("image")
            require(
                found == self.views,
                f"{self._folder.path} holds {found} images, but this session knows {self.views}: another process has "
                "added some; make the session again, which reads them",
            )
            yield self._folder


def _warn_of_little(proposal: Proposal) -> None:
    """A best view may be worth nothing: of candidates that look elsewhere, or once all has been seen."""
    value, error = float(proposal.value), proposal.standard_error
    if value <= (0.0 if error is None else 3.0 * error):
        sure = "" if error is None else f" ± {error:.2g}"
        warnings.warn(
            f"the best view is worth {value:.3g}{sure}: none is sure to show anything new. Stop, or give poses that "
            "look at the box from elsewhere",
            stacklevel=4,
        )
