"""`jaxnbv run` on a mesh: its folder, its sensor and its output."""

import json
from unittest import mock

import numpy as np
import pytest
import trimesh
from commands import run_command, run_without_error

from jaxnbv.checks import InputError
from jaxnbv.planning.planner import Planner


@pytest.fixture
def ring(tmp_path):
    """A folder with a mesh whose surface is at most 1.25 from the centre."""
    trimesh.creation.torus(1.0, 0.4).export(tmp_path / "ring.ply")
    return tmp_path


# This search needs no samples, and takes seconds.
FARTHEST = ("run", "ring.ply", "--search", "farthest", "--views", "2", "--no-report")


def border_hits(file):
    """Number of rays along the image's border that hit the object, and of all rays."""
    with np.load(file) as view:
        side = round(len(view["scan.mask"]) ** 0.5)
        image = view["scan.mask"].reshape(side, side)
    return int(image.sum() - image[1:-1, 1:-1].sum()), int(image.sum())


@pytest.mark.parametrize("asked", [(), ("--task", "heat")])
def test_an_object_fits_the_view(asked, ring):
    run_without_error(*FARTHEST, *asked, "--out", "mine", cwd=ring)
    for file in sorted((ring / "mine").glob("view_*.npz")):
        hits, total = border_hits(file)
        assert hits == 0
        assert total > 100


def test_the_papers_close_up_is_there_when_asked(ring):
    run_without_error(*FARTHEST, "--paper", cwd=ring)
    out = ring / "runs" / "ring-coverage-farthest-seed0"
    assert border_hits(out / "view_00.npz")[0] > 20
    config = json.loads((out / "episode.json").read_text())["config"]
    assert config["planner"]["camera"]["fov"] == pytest.approx(np.radians(30))
    assert config["planner"]["search"]["candidates"]["radius"] == 2.5
    np.testing.assert_allclose(config["first"]["position"]["values"], [0.8, 0.9, 2.2])


def test_a_view_is_printed_when_it_is_done(ring):
    """The line is printed before the search for the next view, which fails here."""
    with mock.patch.object(Planner, "choose", side_effect=InputError("stopped here")):
        result = run_command(*FARTHEST, cwd=ring)
    assert "stopped here" in result.stderr
    assert "view 1   (" in result.stdout
    assert "view 2" not in result.stdout


@pytest.mark.parametrize(
    ("search", "model"),
    [
        ("farthest", "screened"),
        pytest.param("random", "paper", marks=pytest.mark.slow),
        ("uncertainty", "paper"),
        pytest.param("gradient-constrained", "screened", marks=pytest.mark.slow),
    ],
)
def test_run_takes_a_mesh_each_search_and_each_model(search, model, ring):
    named = () if model == "screened" else ("--model", model)
    arguments = ("run", "ring.ply", "--quick", "--views", "2", "--search", search, "--out", "mine", "--no-report")
    run_without_error(*arguments, *named, cwd=ring)
    config = json.loads((ring / "mine" / "episode.json").read_text())["config"]
    sampler = config["planner"]["sampler"]
    assert sampler["model"]["type"].partition(":")[2] == {"screened": "ScreenedSPSR", "paper": "GeometricSPSR"}[model]
    assert (sampler["carving"] is None) == (model == "paper")
    with np.load(ring / "mine" / "view_01.npz") as view:
        positions, values = view["proposal.candidates.position"], view["proposal.values"]
        if "proposal.trajectories.values" in view:
            positions = np.concatenate([positions, view["proposal.trajectories.poses.position"].reshape(-1, 3)])
            values = np.concatenate([values, view["proposal.trajectories.values"].ravel()])
        chosen = np.flatnonzero((positions == view["pose.position"]).all(axis=1))
        assert values[chosen].max() == values.max() == view["proposal.value"]


@pytest.mark.slow
def test_a_published_checkpoint_classifies_a_mesh(ring, shared):
    network = str(shared / "reference" / "pointnet2_cls_ssg.pth")
    arguments = ("--task", "mixed", "--network", network, "--quick", "--views", "2", "--no-report")
    result = run_without_error("run", "ring.ply", *arguments, cwd=ring)
    assert "(was " in result.stdout
