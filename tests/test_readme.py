"""The README's example runs as it is written, at the full settings."""

import re
from pathlib import Path

import jax
import numpy as np
import pytest

import jaxnbv as nbv
from jaxnbv.datasets import demo_object
from jaxnbv.scanning.sdf import Sphere

README = Path(__file__).resolve().parents[1] / "README.md"


def python_blocks() -> list[str]:
    return re.findall(r"```python\n(.*?)```", README.read_text(), flags=re.DOTALL)


def test_the_script_runs_as_written(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    nbv.mesh_from_sdf(demo_object().sdf, nbv.Grid(64)).to_trimesh().export("spot.obj")
    generator = np.random.default_rng(0)
    directions = generator.normal(size=(300, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    camera, pose = nbv.Camera(), nbv.look_at((0.0, 0.0, 2.5))
    sphere = nbv.SDFSurface(Sphere(1.0))
    seen = nbv.scan(sphere, camera, pose)
    local = (np.asarray(seen.points) - np.asarray(pose.position)) @ np.asarray(pose.rotation)
    names = {
        "points": directions,
        "normals": directions,
        "x": directions[:5],
        "key": jax.random.key(2),
        # Its points alone, which may be told with any pose.
        "scan": nbv.PointCloud(seen.points, seen.normals, seen.mask),
        "camera": camera,
        "pose": pose,
        "depth": np.where(np.asarray(seen.mask), local[:, 2], 0.0).reshape(50, 50),
    }
    exec(python_blocks()[0], names)
    assert len(names["episode"].views) == 5
    assert (tmp_path / "runs" / "spot" / "cloud.ply").exists()
    assert names["fields"](names["x"]).shape == (16, 5)
    assert int(names["state"].num_views) == 1
    radius = np.linalg.norm(names["cloud"].to_numpy()[0], axis=1)
    np.testing.assert_allclose(radius, 1.0, atol=1e-5)


def test_the_other_blocks_run():
    for block in python_blocks()[1:]:
        exec(block, {"nbv": nbv, "jax": jax, "source": np.array([0.0, 1.25, 0.0])})


@pytest.mark.parametrize("name", ["main", "test"])
def test_each_command_is_one_line(name):
    block = re.search(rf"<!-- {name} command -->\n```bash\n(.*?)\n```", README.read_text(), flags=re.DOTALL)
    assert block is not None
    assert "\n" not in block.group(1)
