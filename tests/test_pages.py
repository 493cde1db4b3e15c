"""The programs of the README and of the site's pages run, one for each page."""

import dataclasses
import json
import re
import sys
from contextlib import nullcontext
from pathlib import Path
from types import ModuleType, SimpleNamespace

import jax
import numpy as np
import pytest
import trimesh
from PIL import Image
from test_documents import parse

import jaxnbv as nbv
from jaxnbv.networks import pretrained_classifier, save_checkpoint
from jaxnbv.studies.scenes import demo_object

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
PAGES = sorted(str(path.relative_to(DOCS)) for path in DOCS.rglob("*.md"))
SMALL = nbv.GeometricSPSR(0.05, 0.2, 8)
INTRINSICS = np.array([[600.0, 0.0, 325.0], [0.0, 605.0, 236.0], [0.0, 0.0, 1.0]])
CORNERS = {"low": (-0.15, -0.15, 0.005), "high": (0.15, 0.15, 0.255)}


def blocks(page: str, language: str = "python") -> list[str]:
    return re.findall(rf"(?ms)^```{language}\n(.*?)^```$", (DOCS / page).read_text())


PROGRAMS = [page for page in PAGES if blocks(page) and page != "how_to/depth_camera.md"]


def smaller(planner_of=nbv.Planner):
    """Replace `Planner` by one with smaller settings where computation is long. Models of a page's own stay."""

    def make(*arguments, **named):
        planner = planner_of(*arguments, **named)
        model = planner.sampler.model
        if isinstance(model, nbv.ScreenedSPSR):
            model = dataclasses.replace(model, base=SMALL)
        elif isinstance(model, nbv.GeometricSPSR):
            model = SMALL
        sampler = dataclasses.replace(planner.sampler, model=model, grid=nbv.Grid(24), num_samples=2)
        camera = nbv.Camera(height=12, width=12)
        return dataclasses.replace(planner, sampler=sampler, capacity=512, camera=camera)

    make.for_parts = planner_of.for_parts
    return make


def before_arm(monkeypatch):
    """A session's default planner with smaller settings."""
    sampler = nbv.SurfaceSampler(SMALL, grid=nbv.Grid(24), num_samples=2)
    planner = nbv.Planner(
        nbv.NewSurface(), nbv.DiscreteSearch(24), nbv.Camera(height=12, width=16), sampler, capacity=512
    )
    monkeypatch.setattr("jaxnbv.planning.session.usual_planner", lambda: planner)


class Tensor(np.ndarray):
    def numpy(self):
        return np.asarray(self)


def stand_in(monkeypatch, name: str, **members) -> None:
    module = ModuleType(name)
    vars(module).update(members)
    monkeypatch.setitem(sys.modules, name, module)


def before_mesh(monkeypatch):
    nbv.mesh_from_sdf(demo_object().sdf, nbv.Grid(32)).to_trimesh().export("spot.obj")


def before_pytorch(monkeypatch):
    """A model that classifies by the height of the points, in place of PyTorch."""

    def log_softmax(logits, dim):
        return (logits - np.log(np.exp(logits).sum(axis=dim, keepdims=True))).view(Tensor)

    def load(path):
        return SimpleNamespace(eval=lambda: lambda points: points[..., 1].mean(axis=1)[:, None] * np.arange(5.0))

    functions = {"Tensor": Tensor, "from_numpy": np.asarray, "no_grad": nullcontext, "log_softmax": log_softmax}
    stand_in(monkeypatch, "torch", jit=SimpleNamespace(load=load), **functions)
    save_checkpoint(pretrained_classifier("pyramid", num_points=64).network, "net.safetensors")


def before_cluster(monkeypatch):
    """Fake clusters, and a command that is not run."""

    class Started:
        scheduler_address = "tcp://HOST:8786"

        def __init__(self, **settings):
            assert "NPROC" in str(settings)

        def adapt(self, maximum_jobs):
            assert maximum_jobs > 1

        def close(self):
            pass

    stand_in(monkeypatch, "dask_jobqueue", SLURMCluster=Started)
    stand_in(monkeypatch, "dask_kubernetes")
    stand_in(monkeypatch, "dask_kubernetes.operator", KubeCluster=Started)
    monkeypatch.setenv("NPROC", "")
    monkeypatch.setattr("subprocess.run", lambda words, check: parse(words[1:]))


# Preparations that a page leaves to its reader.
BEFORE = {
    "how_to/arm.md": before_arm,
    "how_to/cluster.md": before_cluster,
    "how_to/mesh.md": before_mesh,
    "how_to/pytorch_classifier.md": before_pytorch,
}
NAMES = {"how_to/utility.md": {"source": np.array([0.0, 1.25, 0.0])}}


@pytest.fixture
def as_before():
    """Restore the default device after a page."""
    yield
    jax.config.update("jax_default_device", None)


@pytest.mark.slow
@pytest.mark.usefixtures("as_before")
@pytest.mark.parametrize("page", PROGRAMS)
def test_the_program_of_a_page_runs(page, tmp_path, monkeypatch):
    """The program is as written, except for sizes. Reports have their own tests."""
    monkeypatch.chdir(tmp_path)
    BEFORE.get(page, lambda _: None)(monkeypatch)
    reported = []
    monkeypatch.setattr(nbv, "Planner", smaller())
    monkeypatch.setattr(nbv, "write_report", lambda episode, folder: reported.append(episode))
    program = "\n".join(blocks(page))
    names = {"__name__": "page", **NAMES.get(page, {})}
    exec(compile(program, page, "exec"), names)
    assert len(reported) == program.count("nbv.write_report(")
    for name in re.findall(r"(?m)^(\w+) = planner\.propose\(", program):
        assert np.isfinite(float(names[name].value))


# A model that is quick to compile. Smaller numbers of views, samples, nodes, points, rays and candidates.
LESS = {
    "nbv.ScreenedSPSR(),": "nbv.GeometricSPSR(0.05, 0.2, 8),",
    "views=5": "views=2",
    "num_samples=16": "num_samples=2, grid=nbv.Grid(24)",
    "nbv.NewSurface(),": "nbv.NewSurface(), capacity=512, camera=nbv.Camera(height=12, width=12),",
    "nbv.DiscreteSearch(),": "nbv.DiscreteSearch(12),",
}


def test_the_script_of_the_readme_runs(tmp_path, monkeypatch):
    """The script is as written, except for sizes, with a scan that has only points."""
    monkeypatch.chdir(tmp_path)
    trimesh.creation.icosphere().export("spot.obj")
    script = blocks("../README.md")[0]
    for text, less in LESS.items():
        assert script.count(text) == 1
        script = script.replace(text, less)
    pose = nbv.look_at((0.0, 0.0, 2.5))
    cloud = nbv.scan(nbv.SDFSurface(nbv.sdf.Sphere(1.0)), nbv.Camera(height=12, width=12), pose)
    scan = nbv.PointCloud(cloud.points, cloud.normals, cloud.mask)
    variables = {
        "key": jax.random.key(2),
        "pose": pose,
        "scan": scan,
        "next_scan": scan,
        "x": np.random.default_rng(0).normal(size=(5, 3)),
    }
    exec(compile(script, "README.md", "exec"), variables)
    assert len(variables["episode"].views) == 2
    assert variables["fields"](variables["x"]).shape == (16, 5)
    assert int(variables["observations"].num_views) == 2
    assert (tmp_path / "runs" / "spot" / "cloud.ply").exists()


@pytest.mark.slow
def test_the_block_of_episodes_runs():
    """Two of 64 scenes, and two views."""
    block = blocks("../README.md")[1].replace("64", "2").replace("views=5", "views=2")
    variables = {"nbv": nbv, "jax": jax, "planner": smaller()(nbv.NewSurface(), nbv.DiscreteSearch(12))}
    exec(compile(block, "README.md", "exec"), variables)
    assert variables["batch"].values.shape == (2, 2)
    assert np.isfinite(variables["batch"].values[:, 1]).all()


def image_of_a_ball(matrix):
    """A ball of 0.1 metres on the table z = 0, as depths along the camera's axis in millimetres."""
    matrix = np.asarray(matrix, np.float64)
    row, column = np.indices((480, 640))
    rays = np.stack([column, row, np.ones_like(row)], axis=-1) @ np.linalg.inv(INTRINSICS).T @ matrix[:3, :3].T
    away = matrix[:3, 3] - [0.0, 0.0, 0.1]
    a, b, c = np.sum(rays**2, axis=-1), rays @ away, away @ away - 0.1**2
    with np.errstate(invalid="ignore", divide="ignore"):
        ball, table = (-b - np.sqrt(b**2 - a * c)) / a, -matrix[2, 3] / rays[..., 2]
    depth = np.fmin(ball, np.where(table > 0, table, np.nan))
    return np.round(1000 * np.nan_to_num(depth, posinf=0.0)).clip(0, 65535).astype(np.uint16)


def noisy_image_of_a_ball(matrix):
    """Return `image_of_a_ball` with two pixels that depend on the camera's position, so that images differ."""
    image = image_of_a_ball(matrix)
    image[0, :2] = 1 + (1e4 * np.abs(np.asarray(matrix)[:2, 3] + 1.0)).astype(int) % 97
    return image


def poses_about_a_ball(count):
    angle = 2.0 * np.pi * np.arange(count) / count
    places = np.stack([0.8 * np.cos(angle), 0.8 * np.sin(angle), 0.3 + 0.2 * (np.arange(count) % 2)], axis=1)
    return np.asarray(nbv.look_at(places, (0.0, 0.0, 0.1), up=(0.0, 0.0, 1.0)).matrix)


@pytest.mark.slow
def test_the_block_of_a_session_runs(tmp_path, monkeypatch):
    """Runs until the ball is expected to be covered. Reports of sessions have their own tests."""
    monkeypatch.chdir(tmp_path)
    reported = []
    monkeypatch.setattr(nbv, "write_report", lambda episode, folder: reported.append(episode))
    poses = poses_about_a_ball(10)
    model, search = nbv.GeometricSPSR(0.02, 0.2, 16), nbv.DiscreteSearch()
    planner = nbv.Planner(
        nbv.NewSurface(),
        search,
        nbv.Camera(height=18, width=24),
        nbv.SurfaceSampler(model, grid=nbv.Grid(40), num_samples=2),
        capacity=2048,
    )
    monkeypatch.setattr("jaxnbv.planning.session.usual_planner", lambda: planner)
    variables = {"K": INTRINSICS, **CORNERS, "places": poses, "first": poses[0], "take_image": noisy_image_of_a_ball}
    (block,) = (block for block in blocks("how_to/depth_camera.md") if "take_image" in block)
    exec(block, variables)
    session = variables["session"]
    assert 2 <= len(session.views) < 10
    assert "expected to be covered" in session.done()
    assert len(reported[0].views) == len(session.views)
    points, _ = session.cloud.to_numpy()
    assert np.abs(np.linalg.norm(points - [0.0, 0.0, 0.1], axis=1) - 0.1).max() < 0.01
    assert points[:, 0].min() < -0.08
    assert points[:, 0].max() > 0.08
    # The loaded session is the same.
    (block,) = (block for block in blocks("how_to/depth_camera.md") if "Session.load" in block)
    exec(block, variables)
    assert variables["session"] is not session
    assert len(variables["session"].views) == len(session.views)
    assert variables["session"].done() == session.done()


@pytest.mark.slow
def test_the_block_for_a_recording_runs(tmp_path, monkeypatch):
    pose = nbv.look_at((0.6, -0.6, 0.4), (0.0, 0.0, 0.1), up=(0.0, 0.0, 1.0))
    folder = tmp_path / "recording"
    folder.mkdir()
    Image.fromarray(image_of_a_ball(pose.matrix)).save(folder / "0.png")
    frames = [{"depth": "0.png", "pose": np.asarray(pose.matrix).tolist()}]
    said = {"intrinsics": np.asarray(INTRINSICS).tolist(), "depth_scale": 0.001, "frames": frames}
    (folder / "frames.json").write_text(json.dumps(said))
    monkeypatch.chdir(tmp_path)
    variables = {"nbv": nbv, **CORNERS}
    (block,) = (block for block in blocks("how_to/depth_camera.md") if "RecordedFrames" in block)
    exec(block, variables)
    assert int(variables["session"].cloud.count) > 100


@pytest.mark.slow
def test_the_block_for_a_depth_camera_runs(monkeypatch):
    pose = nbv.look_at((0.6, -0.6, 0.4), (0.0, 0.0, 0.1), up=(0.0, 0.0, 1.0))
    sampler = nbv.SurfaceSampler(nbv.GeometricSPSR(0.05, 0.2, 8), grid=nbv.Grid(24), num_samples=2)
    small = nbv.Planner(nbv.NewSurface(), nbv.DiscreteSearch(12), nbv.Camera(height=12, width=12), sampler)
    monkeypatch.setattr(nbv, "Planner", lambda *_: small)
    variables = {
        "nbv": nbv,
        "camera": nbv.Camera.from_intrinsics(INTRINSICS, 480, 640),
        "T": np.asarray(pose.matrix),
        **CORNERS,
        "depth_mm": image_of_a_ball(pose.matrix),
        "key": jax.random.key(0),
    }
    (block,) = (block for block in blocks("how_to/depth_camera.md") if "depth_mm" in block)
    exec(block, variables)
    points = variables["cloud"].to_numpy()[0]
    assert len(points) > 100
    assert np.abs(np.linalg.norm(points - [0.0, 0.0, 0.1], axis=1) - 0.1).max() < 0.01
    # Candidates stand on a sphere of 2.5 scene units about the box, whose longest side is 2.5, and look at its centre.
    place, forward = variables["matrix"][:3, 3] - np.array([0.0, 0.0, 0.13]), variables["matrix"][:3, 2]
    assert np.linalg.norm(place) == pytest.approx(0.3, abs=1e-4)
    np.testing.assert_allclose(forward, -place / np.linalg.norm(place), atol=1e-4)


def test_no_block_of_the_depth_camera_is_left_out():
    assert len(blocks("how_to/depth_camera.md")) == 4
