"""Episodes: the views of one object, with the planner, scene and key that they depend on."""

import dataclasses
import itertools
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from jaxnbv.acquisition import Acquisition, ImaginedView, context_of
from jaxnbv.checks import check_type, require
from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.frame import Frame
from jaxnbv.geometry.pose import Pose
from jaxnbv.observations import Observations
from jaxnbv.planning.loop import View
from jaxnbv.planning.planner import Planner
from jaxnbv.programs import program
from jaxnbv.scanning import Noise, Surface
from jaxnbv.search import Proposal
from jaxnbv.storage import RunFolder


@program
def _score(acquisition: Acquisition, context: Any, view: ImaginedView) -> Float[Array, ""]:
    return acquisition.score(context, view)


class Episode(eqx.Module):
    """The views that a planner chose for a scene, in scene coordinates, and everything they depend on.

    - `scene`, `noise`: true surface and sensor noise; None if a real sensor took the views.
    - `stop_reason`: the stop rule's reason to end the episode; None if no rule ended it.
    - `frame`: frame of the user's world, in which the episode is shown and its cloud is saved.
    """

    planner: Planner
    scene: Surface | None
    noise: Noise | None
    first: Pose
    key: PRNGKeyArray
    views: tuple[View, ...] = ()
    stop_reason: str | None = None
    frame: Frame = Frame()

    @property
    def sensor(self) -> Camera:
        """The camera that takes the views, in scene units."""
        return self.views[0].camera if self.views else self.planner.camera

    @property
    def cloud(self) -> PointCloud:
        """The cloud D, the points kept from all views, in scene coordinates."""
        return self.views[-1].cloud

    def observations(self) -> Iterator[Observations]:
        """Yield the planner's observations after each view, computed again from the scans."""
        return self.planner.replay(((view.pose, view.scan) for view in self.views), self.sensor)

    def observations_after(self, views: int) -> Observations:
        """Return the planner's observations after the first `views` views.

        **Raises:** `ValueError` unless 1 <= `views` <= the number of views.
        """
        check_type(views, int, "the number of views")
        require(1 <= views <= len(self.views), f"asked for {views} of {len(self.views)} views; ask for at least one")
        return next(itertools.islice(self.observations(), views - 1, None))

    def actual_scores(self, observations: Iterable[Observations] | None = None) -> Iterator[float | None]:
        """Yield the acquisition's score of each view's actual scan, given the observations before the view.

        Scores are in scene units, like the values of proposals. The first view has the score None.

        - `observations`: result of `observations()`, if you have it already.
        """
        yield None
        acquisition = self.planner.acquisition
        all_observations = self.observations() if observations is None else observations
        for observations_before, view in zip(all_observations, self.views[1:], strict=False):
            context = context_of(acquisition, observations_before)
            yield float(_score(acquisition, context, ImaginedView(view.scan, view.camera, view.pose)))

    @classmethod
    def load(cls, path: str | Path, planner: Planner | None = None, scene: Surface | None = None) -> "Episode":
        """Load a saved episode, or the views that `simulate` has stored so far.

        - `planner`, `scene`: planner and scene to use if the stored ones hold a function or network that cannot be
          restored. Their descriptions must equal the stored descriptions.

        **Raises:** `ValueError` if the folder holds no episode or no view, or if its planner or scene cannot be
        restored.
        """
        replacements = {name: value for name, value in (("planner", planner), ("scene", scene)) if value is not None}
        config = RunFolder.config_of(path, "episode", **replacements)
        folder = RunFolder(path, "episode", config)
        stored_views = read_views(folder)
        require(len(stored_views) > 0, f"{path} holds no view yet")
        camera = config.pop("camera")
        episode = cls(**config)
        all_observations = episode.planner.replay(((pose, scan) for pose, scan, _ in stored_views), camera)
        views = tuple(
            View(pose, scan, observations.cloud, proposal, camera, observations.hypotheses)
            for (pose, scan, proposal), observations in zip(stored_views, all_observations, strict=True)
        )
        return dataclasses.replace(episode, views=views, stop_reason=_read_end(folder, len(views)))

    def save(self, path: str | Path) -> None:
        """Save the episode to a folder (see `jaxnbv.storage` for its files). `simulate` can continue from it.

        **Raises:** `ValueError` if the folder holds other files, an episode of another configuration, or more views
        than this episode.
        """
        folder = self.open(path)
        with folder.writing():
            count = folder.count("view")
            require(
                count <= len(self.views),
                f"{path} already holds {count} views of this episode, which has {len(self.views)}: "
                "choose another folder",
            )
            for index, view in enumerate(self.views):
                folder.write("view", index, pose=view.pose, scan=view.scan, proposal=view.proposal)
            self.write_end(folder)

    def write_end(self, folder: RunFolder) -> None:
        """Write the reason why the episode ended, and its cloud in world units."""
        reason = None if self.stop_reason is None else np.array(self.stop_reason)
        folder.write("end", 0, reason=reason, views=np.array(len(self.views)))
        folder.write_cloud(self.frame.to_world(self.cloud))

    def open(self, path: str | Path) -> RunFolder:
        """Open or create a folder for the views of this episode, and return it.

        **Raises:** `ValueError` if the folder holds results of a different configuration, or other files.
        """
        names = ("planner", "scene", "noise", "first", "key", "frame")
        config = {name: getattr(self, name) for name in names}
        return RunFolder(path, "episode", config | {"camera": self.sensor})


def read_views(folder: RunFolder) -> list[tuple[Pose, PointCloud, Proposal | None]]:
    """Return the pose, scan and proposal of every view in a folder.

    **Raises:** `ValueError` if a view is damaged, or missing between others.
    """
    views = (folder.read("view", index) for index in range(folder.count("view")))
    return [(view["pose"], view["scan"], view.get("proposal")) for view in views]


def _read_end(folder: RunFolder, views: int) -> str | None:
    """Return why a rule ended an episode after `views` views; None if no rule did."""
    if not folder.file("end", 0).exists():
        return None
    end = folder.read("end", 0)
    return str(end["reason"]) if "reason" in end and int(end["views"]) == views else None
