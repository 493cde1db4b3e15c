"""Where to look next as a decision process, for policies that are learned: an environment of Gymnasium."""

from collections.abc import Callable
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import spaces
from jaxtyping import Array, Float

from jaxnbv.checks import check_type, checked, require, shown
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.pose import Pose
from jaxnbv.planning.episode import observe_scene
from jaxnbv.planning.planner import Planner
from jaxnbv.scanning import Evidence, SensorNoise, Surface, as_surface
from jaxnbv.scanning.scanner import Noise
from jaxnbv.scanning.sdf import SignedDistance
from jaxnbv.search import Candidates, PoseSpace

Observation = dict[str, np.ndarray]


class ViewEnvironment(gymnasium.Env[Observation, Any]):
    """Views of a scene that `reset` draws, the first from a random pose. An episode is truncated after so many views;
    it never terminates.

    An observation is what a sensor gives: `depth` (height, width), along the camera's axis, 0 where nothing was met,
    and `matrix` (4, 4), camera to scene in OpenCV's axes; in scene units. The reward is by how much the utility rose.

    - `planner`: whose camera, capacity and surroundings are the environment's; its search is not asked.
    - `scene`: from a number to a surface or solid.
    - `utility`: of the cloud that is kept.
    - `actions`: `Candidates`, of which an action is the number, or a `PoseSpace`, in which an action is the parameters
      that move the last pose, each within [-1, 1].
    - `views`: in all. `scenes`: how many numbers scenes are drawn from, from 0. `noise`: the sensor's.

    **Raises:** `ValueError` for fewer than two views or no scene, and from `step` for what is no action.
    """

    @checked
    def __init__(
        self,
        planner: Planner,
        scene: Callable[[int], Surface | SignedDistance],
        utility: Callable[[PointCloud], Float[Array, ""]],
        actions: Candidates | PoseSpace,
        views: int = 5,
        scenes: int = 2**31 - 1,
        noise: Noise = SensorNoise(),
    ):
        require(views >= 2, f"an episode of {views} views leaves nothing to decide: give two or more")
        require(scenes >= 1, f"there are {scenes} scenes to draw from: give one or more")
        require(
            planner.max_views >= views,
            f"the planner has room for {planner.max_views} views, fewer than the {views} asked",
        )
        self.planner, self.scene, self.utility, self.actions = planner, scene, utility, actions
        self.views, self.scenes, self.noise = views, scenes, noise
        shape = planner.camera.height, planner.camera.width
        depth, matrix = spaces.Box(0.0, np.inf, shape, np.float32), spaces.Box(-np.inf, np.inf, (4, 4), np.float32)
        self.observation_space: Any = spaces.Dict({"depth": depth, "matrix": matrix})
        self.action_space: Any = (
            spaces.Discrete(actions.count)
            if isinstance(actions, Candidates)
            else spaces.Box(-1.0, 1.0, (actions.num_parameters,), np.float32)
        )
        self._poses = actions.poses() if isinstance(actions, Candidates) else actions.candidates(1, None)
        self._evidence: Evidence | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Draw a scene and its first view."""
        super().reset(seed=seed)
        number = int(self.np_random.integers(self.scenes))
        surface = self.scene(number)
        check_type(surface, Surface | SignedDistance, "the scene")
        self._surface, self._evidence = as_surface(surface), None
        if isinstance(self.actions, Candidates):
            first = self._poses[int(self.np_random.integers(self.actions.count))]
        else:
            first = self.actions.candidates(1, self._key())[0]
        observation = self._look(first)
        return observation, {"scene": number, "utility": self._value}

    def step(
        self, action: int | np.integer | Float[np.ndarray, " parameters"]
    ) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Look from where the action says."""
        require(self._evidence is not None, "the environment has no scene yet: call reset first")
        require(self.action_space.contains(action), f"{shown(action)} is no action of {self.action_space}")
        if isinstance(self.actions, Candidates):
            pose = self._poses[int(action)]
        else:
            pose = self.actions.retract(self._pose, jnp.asarray(action))
        before = self._value
        observation = self._look(pose)
        assert self._evidence is not None
        enough = int(self._evidence.num_views) >= self.views
        return observation, self._value - before, False, enough, {"utility": self._value}

    def _look(self, pose: Pose) -> Observation:
        planner, around = self.planner, self.planner.imagination.surroundings
        scan = observe_scene(self._surface, planner.camera, pose, self.noise, self._key(), around)
        known = self._evidence
        self._evidence = planner.init(pose, scan) if known is None else planner.observe(known, pose, scan)
        self._pose, self._value = pose, float(self.utility(self._evidence.cloud))
        along = jnp.matmul(scan.points - pose.position, pose.forward, precision="highest")
        depth = jnp.where(scan.mask, jnp.maximum(along, 0.0), 0.0).reshape(planner.camera.height, planner.camera.width)
        return {"depth": np.asarray(depth, np.float32), "matrix": np.asarray(pose.matrix, np.float32)}

    def _key(self) -> Array:
        return jax.random.key(int(self.np_random.integers(2**31)))
