"""The folder of an episode: its contents, exact reading, continuation, and its one configuration."""

import json
import shutil

import equinox as eqx
import jax
import numpy as np
import pytest
import trimesh
from plyfile import PlyData
from small_episode import contents, run
from small_planner import planner_of

from jaxnbv.checks import InputError
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.pose import look_at
from jaxnbv.planning.episode import read_views
from jaxnbv.planning.planner import Planner
from jaxnbv.scanning import SensorNoise
from jaxnbv.search import FarthestView
from jaxnbv.storage import RunFolder


def test_views_come_back_with_the_same_bits(finished):
    episode, folder = finished
    views = read_views(episode.open(folder))
    assert len(views) == 5
    assert views[0][2] is None
    assert all(0 < np.asarray(scan.missed).sum() < 64 for _, scan, _ in views)
    for read, view in zip(views, episode.views, strict=True):
        written = (view.pose, view.scan, view.proposal)
        assert jax.tree.structure(read) == jax.tree.structure(written)
        for a, b in zip(jax.tree.leaves(read), jax.tree.leaves(written), strict=True):
            assert a.dtype == b.dtype
            np.testing.assert_array_equal(a, b)


def test_a_scan_that_is_no_image_reads_as_one(finished, tmp_path):
    episode, _ = finished
    view, folder = episode.views[0], RunFolder(tmp_path, "episode", {})
    cloud = PointCloud(view.scan.points, view.scan.normals, view.scan.mask)
    folder.write("view", 0, pose=view.pose, scan=cloud, proposal=None)
    ((_, read, _),) = read_views(folder)
    assert read.missed is None
    np.testing.assert_array_equal(read.points, cloud.points)


def test_the_record_says_what_made_it(finished):
    record = json.loads((finished[1] / "episode.json").read_text())
    assert set(record["config"]) == {"planner", "scene", "noise", "first", "key", "frame", "camera"}
    assert record["config"]["planner"]["sampler"]["num_samples"] == 3
    assert record["versions"]["jax"] == jax.__version__
    np.testing.assert_allclose(record["config"]["first"]["position"]["values"], [0.8, 0.9, 2.2], atol=1e-6)


def test_the_cloud_reads_back_in_other_programs(finished):
    episode, folder = finished
    points, normals = episode.cloud.to_numpy()
    vertices = PlyData.read(folder / "cloud.ply")["vertex"]
    np.testing.assert_array_equal(np.stack([vertices[name] for name in ("x", "y", "z")], axis=1), points)
    np.testing.assert_array_equal(np.stack([vertices[name] for name in ("nx", "ny", "nz")], axis=1), normals)
    np.testing.assert_array_equal(np.asarray(trimesh.load(folder / "cloud.ply").vertices, np.float32), points)
    assert len(points) == int(episode.cloud.count) > 64


def test_saving_afterwards_writes_what_a_run_into_the_folder_writes(finished, tmp_path):
    episode, folder = finished
    episode.save(tmp_path / "saved")
    assert contents(tmp_path / "saved") == contents(folder)
    assert set(contents(folder)) == {"episode.json", "cloud.ply", "end_00.npz", *(f"view_0{i}.npz" for i in range(5))}


def test_three_views_continued_to_five_equal_five(finished, tmp_path):
    _, folder = finished
    run(tmp_path / "run", views=3)
    assert len(contents(tmp_path / "run")) == 6
    episode = run(tmp_path / "run", views=5)
    assert contents(tmp_path / "run") == contents(folder)
    ends = [(each.views, each.observations_after(5)) for each in (episode, finished[0])]
    for a, b in zip(*map(jax.tree.leaves, ends), strict=True):
        np.testing.assert_array_equal(a, b)
    assert ends[0][1].empty_nodes.shape == (24, 24, 24)


def test_a_finished_run_is_read_not_computed(finished, monkeypatch):
    before = contents(finished[1])
    monkeypatch.setattr(Planner, "choose", lambda *_: pytest.fail("a finished view was chosen again"))
    monkeypatch.setattr(
        "jaxnbv.planning.simulate.observe_scene", lambda *_: pytest.fail("a finished view was scanned again")
    )
    run(finished[1], views=5)
    assert contents(finished[1]) == before


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"planner": planner_of(num_samples=4)}, r"planner\.sampler\.num_samples: 3 there, 4 now"),
        (
            {"planner": planner_of(FarthestView(12))},
            r"planner\.search\.type: 'jaxnbv\.search\.discrete:DiscreteSearch' there",
        ),
        ({"noise": SensorNoise(0.03)}, r"noise\.points: 0\.01 there, 0\.03 now"),
        ({"key": jax.random.key(9)}, r"key\.data: \[0, 0\] there, \[0, 9\] now"),
        ({"first": look_at((0.8, 0.9, 2.3))}, r"first\.position"),
    ],
)
def test_a_folder_of_another_configuration_is_refused(finished, change, named):
    before = contents(finished[1])
    with pytest.raises(ValueError, match=r"another episode.*" + named + r".*Choose another folder"):
        run(finished[1], **change)
    assert contents(finished[1]) == before


def test_a_folder_with_other_files_is_refused(tmp_path):
    (tmp_path / "thesis.tex").write_text("years of work")
    with pytest.raises(ValueError, match=r"holds other files \(thesis\.tex\): choose an empty folder"):
        run(tmp_path)
    assert contents(tmp_path) == {"thesis.tex": b"years of work"}


def test_leftover_parts_do_not_matter(finished, tmp_path):
    for name in (".0123456789abcdef.partial", ".00000000000000ff.partial"):
        (tmp_path / name).write_bytes(b"half a fi")
    # It is not a file of the package, and so is not touched.
    (tmp_path / "mine.partial").write_bytes(b"half a thesis")
    run(tmp_path, views=5)
    assert contents(tmp_path) == contents(finished[1]) | {"mine.partial": b"half a thesis"}


def test_fewer_views_than_the_folder_holds_are_refused(finished):
    episode, folder = finished
    with pytest.raises(ValueError, match=r"asked for 1 views but .* already holds 5"):
        run(folder, views=1)
    with pytest.raises(ValueError, match="already holds 5 views"):
        eqx.tree_at(lambda e: e.views, episode, episode.views[:2]).save(folder)


def test_a_folder_of_another_version_warns(finished, tmp_path):
    folder = shutil.copytree(finished[1], tmp_path / "copy")
    record = json.loads((folder / "episode.json").read_text())
    record["versions"]["jax"] = "0.0.1"
    (folder / "episode.json").write_text(json.dumps(record))
    with pytest.warns(UserWarning, match=r"other versions \(jax: '0.0.1' there"):
        run(folder, views=5)


def test_a_folder_without_views_belongs_to_any_configuration(tmp_path, finished):
    """A run whose first view failed leaves an empty folder, and one that was killed between two files a record."""
    with pytest.raises(InputError, match="the first scan is empty"):
        run(tmp_path, first=look_at((0.0, 0.0, 2.5), (0.0, 0.0, 9.0)))
    assert contents(tmp_path) == {}
    run(tmp_path, views=1, key=jax.random.key(9))
    for name in ("view_00.npz", "end_00.npz", "cloud.ply"):
        (tmp_path / name).unlink()
    run(tmp_path, views=5)
    assert contents(tmp_path) == contents(finished[1])


def test_each_is_called_when_a_view_is_done(tmp_path):
    """The view's file exists then, and the next one's does not. Views from the folder are passed too."""
    calls = []

    def each(step):
        calls.append((step.view, len([*tmp_path.glob("view_*.npz")])))

    run(tmp_path, views=2, each=each)
    assert [files for _, files in calls] == [1, 2]
    calls.clear()
    episode = run(tmp_path, views=3, each=each)
    assert [files for _, files in calls] == [2, 2, 3]
    assert all(view is own for (view, _), own in zip(calls, episode.views, strict=True))
