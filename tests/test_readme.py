"""The README's example runs as it is written."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

README = Path(__file__).resolve().parents[1] / "README.md"


def python_blocks() -> list[str]:
    return re.findall(r"```python\n(.*?)```", README.read_text(), flags=re.DOTALL)


# What the README's first block leaves to the reader: a mesh, places, a camera's scan.
BEFORE = """
import jax
import numpy as np
import jaxnbv
from jaxnbv.studies.scenes import demo_object
from jaxnbv.scanning.sdf import Sphere

jaxnbv.mesh_from_sdf(demo_object().sdf, jaxnbv.Grid(64)).to_trimesh().export("spot.obj")
key, camera, pose = jax.random.key(2), jaxnbv.Camera(), jaxnbv.look_at((0.0, 0.0, 2.5))
x = np.random.default_rng(0).normal(size=(5, 3))
seen = jaxnbv.scan(jaxnbv.SDFSurface(Sphere(1.0)), camera, pose)
# Its points alone, which may be told with any pose.
scan = jaxnbv.PointCloud(seen.points, seen.normals, seen.mask)
"""
AFTER = """
assert len(episode.views) == 2
assert fields(x).shape == (16, 5)
assert int(evidence.num_views) == 2
"""


# Less of what takes long alone: frequencies of the prior, views, samples, nodes, points and candidates.
LESS = {
    "nbv.ScreenedSPSR(),": "nbv.ScreenedSPSR(nbv.GeometricSPSR((0.02, 0.06), (0.2, 0.25), truncation=16)),",
    "views=5": "views=2",
    "num_samples=16": "num_samples=4, grid=nbv.Grid(40)",
    "imagination=nbv.Imagination(": "capacity=1024, imagination=nbv.Imagination(",
    "nbv.DiscreteSearch(),": "nbv.DiscreteSearch(24),",
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


@pytest.mark.parametrize("name", ["main", "test"])
def test_each_command_is_one_line(name):
    block = re.search(rf"<!-- {name} command -->\n```bash\n(.*?)\n```", README.read_text(), flags=re.DOTALL)
    assert block is not None
    assert "\n" not in block.group(1)
