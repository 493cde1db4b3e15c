"""The README's examples run as they are written."""

import re
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

import jaxnbv as nbv

README = Path(__file__).resolve().parents[1] / "README.md"


def python_blocks() -> list[str]:
    return re.findall(r"```python\n(.*?)```", README.read_text(), flags=re.DOTALL)


# What the README's first block leaves to the reader: a mesh, arrays, a camera's scan and its depth image.
BEFORE = """
import jax
import numpy as np
import jaxnbv
from jaxnbv.datasets import demo_object
from jaxnbv.scanning.sdf import Sphere

jaxnbv.mesh_from_sdf(demo_object().sdf, jaxnbv.Grid(64)).to_trimesh().export("spot.obj")
directions = np.random.default_rng(0).normal(size=(300, 3))
directions /= np.linalg.norm(directions, axis=1, keepdims=True)
points, normals, x = directions, directions, directions[:5]
key, camera, pose = jax.random.key(2), jaxnbv.Camera(), jaxnbv.look_at((0.0, 0.0, 2.5))
seen = jaxnbv.scan(jaxnbv.SDFSurface(Sphere(1.0)), camera, pose)
local = (np.asarray(seen.points) - np.asarray(pose.position)) @ np.asarray(pose.rotation)
depth = np.where(np.asarray(seen.mask), local[:, 2], 0.0).reshape(50, 50)
# Its points alone, which may be told with any pose.
scan = jaxnbv.PointCloud(seen.points, seen.normals, seen.mask)
"""
AFTER = """
assert len(episode.views) == 2
assert fields(x).shape == (16, 5)
assert int(state.num_views) == 1
np.testing.assert_allclose(np.linalg.norm(cloud.to_numpy()[0], axis=1), 1.0, atol=1e-5)
"""


# Less of what takes long alone: frequencies of the prior, views, samples, nodes, points and candidates.
LESS = {
    "nbv.ScreenedSPSR(),": "nbv.ScreenedSPSR(nbv.GeometricSPSR((0.02, 0.06), (0.2, 0.25), truncation=16)),",
    "views=5": "views=2",
    "num_samples=16": "num_samples=4, grid=nbv.Grid(40), capacity=1024",
    "nbv.DiscreteSearch(),  ": "nbv.DiscreteSearch(24),",
}


def test_the_script_runs_as_written(tmp_path):
    """But for sizes. In a process of its own, without the checks of types."""
    script = python_blocks()[0]
    for text, less in LESS.items():
        assert script.count(text) == 1
        script = script.replace(text, less)
    command = [sys.executable, "-c", "\n".join([BEFORE, script, AFTER])]
    run = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    assert (tmp_path / "runs" / "spot" / "cloud.ply").exists()


INTRINSICS = np.array([[600.0, 0.0, 325.0], [0.0, 605.0, 236.0], [0.0, 0.0, 1.0]])
CORNERS = {"low": (-0.15, -0.15, 0.005), "high": (0.15, 0.15, 0.255)}


def image_of_a_ball(matrix):
    """Of 0.1 metres, on the table z = 0; in millimetres along the camera's axis."""
    matrix = np.asarray(matrix, np.float64)
    row, column = np.indices((480, 640))
    rays = np.stack([column, row, np.ones_like(row)], axis=-1) @ np.linalg.inv(INTRINSICS).T @ matrix[:3, :3].T
    away = matrix[:3, 3] - [0.0, 0.0, 0.1]
    a, b, c = np.sum(rays**2, axis=-1), rays @ away, away @ away - 0.1**2
    with np.errstate(invalid="ignore", divide="ignore"):
        ball, table = (-b - np.sqrt(b**2 - a * c)) / a, -matrix[2, 3] / rays[..., 2]
    depth = np.fmin(ball, np.where(table > 0, table, np.nan))
    return np.round(1000 * np.nan_to_num(depth, posinf=0.0)).clip(0, 65535).astype(np.uint16)


def poses_about_a_ball(count):
    angle = 2.0 * np.pi * np.arange(count) / count
    places = np.stack([0.8 * np.cos(angle), 0.8 * np.sin(angle), 0.3 + 0.2 * (np.arange(count) % 2)], axis=1)
    return np.asarray(nbv.look_at(places, (0.0, 0.0, 0.1), up=(0.0, 0.0, 1.0)).matrix)


def test_the_block_of_a_session_runs(tmp_path, monkeypatch):
    """Until the ball is expected to be covered. Reports of sessions are tested on their own."""
    monkeypatch.chdir(tmp_path)
    reported = []
    monkeypatch.setattr("jaxnbv.session.write_report", lambda episode, folder, **_: reported.append(episode) or folder)
    poses = poses_about_a_ball(10)
    model, search = nbv.GeometricSPSR(0.02, 0.2, 16), nbv.DiscreteSearch()
    given = {
        "nbv": nbv,
        "K": INTRINSICS,
        **CORNERS,
        "reachable": poses,
        "first": poses[0],
        "take_image": image_of_a_ball,
        "planner": nbv.Planner(model, nbv.Camera(height=18, width=24), nbv.Coverage(), search, 2, nbv.Grid(40), 2048),
    }
    (block,) = (block for block in python_blocks() if "nbv.Session(" in block)
    exec(block, given)
    session = given["session"]
    assert 3 <= session.views < 10
    assert "expected to be covered" in session.done
    assert len(reported[0].views) == session.views
    points, _ = session.cloud.to_numpy()
    assert np.abs(np.linalg.norm(points - [0.0, 0.0, 0.1], axis=1) - 0.1).max() < 0.01
    assert points[:, 0].min() < -0.08
    assert points[:, 0].max() > 0.08


def test_the_block_for_a_depth_camera_runs():
    pose = nbv.look_at((0.6, -0.6, 0.4), (0.0, 0.0, 0.1), up=(0.0, 0.0, 1.0))
    small = nbv.GeometricSPSR(0.05, 0.2, 8), nbv.Camera(height=12, width=12), nbv.Coverage(), nbv.DiscreteSearch(12)
    given = {
        "nbv": nbv,
        "np": np,
        "camera": nbv.Camera.from_intrinsics(INTRINSICS, 640, 480),
        "T": np.asarray(pose.matrix),
        **CORNERS,
        "depth_mm": image_of_a_ball(pose.matrix),
        "planner": nbv.Planner(*small, num_samples=2, grid=nbv.Grid(24)),
        "key": jax.random.key(0),
    }
    (block,) = (block for block in python_blocks() if "depth_mm" in block)
    exec(block, given)
    points = given["cloud"].to_numpy()[0]
    assert len(points) > 100
    assert np.abs(np.linalg.norm(points - [0.0, 0.0, 0.1], axis=1) - 0.1).max() < 0.01
    # Candidates stand on a sphere of 2.5 scene units about the box, whose longest side is 2.5, and look at its centre.
    place, forward = given["matrix"][:3, 3] - np.array([0.0, 0.0, 0.13]), given["matrix"][:3, 2]
    assert np.linalg.norm(place) == pytest.approx(0.3, abs=1e-4)
    np.testing.assert_allclose(forward, -place / np.linalg.norm(place), atol=1e-4)


def test_the_other_blocks_run():
    for block in python_blocks()[1:]:
        if "depth_mm" not in block and "nbv.Session(" not in block:
            exec(block, {"nbv": nbv, "jax": jax, "source": np.array([0.0, 1.25, 0.0])})


@pytest.mark.parametrize("name", ["main", "test"])
def test_each_command_is_one_line(name):
    block = re.search(rf"<!-- {name} command -->\n```bash\n(.*?)\n```", README.read_text(), flags=re.DOTALL)
    assert block is not None
    assert "\n" not in block.group(1)
