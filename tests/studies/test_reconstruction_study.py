"""The reconstruction study on a small scale, and its measures on records made by hand."""

import json

import jax
import numpy as np
import pytest
import trimesh
from PIL import Image

import jaxnbv as nbv
from jaxnbv.checks import InputError
from jaxnbv.readers.class_meshes import mesh_files
from jaxnbv.sampler import SurfaceSampler
from jaxnbv.scanning import scan
from jaxnbv.scanning.metrics import coverage, surface_distance, truth_points
from jaxnbv.scanning.screened_poisson import has_poisson
from jaxnbv.search.candidates import sphere_candidates
from jaxnbv.storage import describe
from jaxnbv.studies import reconstruction
from jaxnbv.studies.engine.pictures import write_pictures
from jaxnbv.studies.engine.results import results, summary
from jaxnbv.studies.engine.run import replay, run_scene
from jaxnbv.studies.reconstruction import MEAN, POISSON, ReconstructionStudy, reconstruct

# Methods without samples compile in a fraction of the time. All planners have the same structure.
RUN = ("farthest", "random")
CANDIDATES = 10
HAS_POISSON = has_poisson()


@pytest.fixture(scope="module")
def meshes(tmp_path_factory):
    """A folder with two objects and their additional files."""
    folder = tmp_path_factory.mktemp("meshes")
    trimesh.creation.torus(1.0, 0.4, 40, 20).export(folder / "b_torus.OBJ", file_type="obj")
    trimesh.creation.box((1.0, 2.0, 3.0)).export(folder / "a_box.ply")
    (folder / "readme.md").write_text("objects")
    (folder / "b_torus.mtl").write_text("newmtl material_0")
    return folder


def small_study(folder=None, views=3, **settings):
    model = nbv.GeometricSPSR(lengthscale=0.05, truncation=8)
    small = {
        "num_candidates": CANDIDATES,
        "num_samples": 2,
        "sampler": SurfaceSampler(model),
        "grid_resolution": 20,
        "capacity": 250,
    }
    meshes = mesh_files(folder) if folder else ()
    return ReconstructionStudy(meshes=meshes, views=views, **(small | settings))


@pytest.fixture(scope="module")
def record(meshes):
    return run_scene(small_study(meshes), 1, RUN)


def test_a_record_is_json_and_holds_every_method(record):
    assert json.loads(json.dumps(record, allow_nan=False)) == record
    assert (record["scene"], record["name"]) == (1, "b_torus")
    assert list(record["methods"]) == list(RUN)
    for method in record["methods"].values():
        assert len({tuple(view["position"]) for view in method["views"]}) == 3
        assert 0 < method["coverage"][0] < method["coverage"][-1] <= 1
        assert 0 < method["points"] <= 250
        for name, distance in method["reconstructions"].items():
            if name == POISSON and not HAS_POISSON:
                assert distance is None
                continue
            assert distance["chamfer"] == distance["accuracy"] + distance["completeness"]
            assert 0 < distance["chamfer"] < 2 * distance["hausdorff"]


def test_planners_differ_in_what_they_seek_and_their_search_alone():
    study = small_study()
    scene = study.scene(0)
    searches = (nbv.DiscreteSearch, nbv.DiscreteSearch, nbv.FarthestView, nbv.search.UncertaintyView, nbv.RandomView)
    own: dict = {"search": None, "acquisition": None}
    for method, search in zip(study.methods, searches, strict=True):
        planner = study.planner(method, scene)
        assert planner.search == search(study.candidates)
        assert isinstance(planner.acquisition, nbv.NewSurface if method == "new-surface" else nbv.Coverage)
        assert describe(planner) | own == describe(study.planner("farthest", scene)) | own


def test_views_are_those_of_an_episode_from_the_shared_first_view(record, meshes):
    study = small_study(meshes)
    scene, poses = study.scene(1), sphere_candidates(CANDIDATES)
    assert bool(scan(scene.surface, nbv.Camera(), poses[record["first"]]).mask.any())
    key = study.key(1, "episode")
    truth = truth_points(scene.surface, study.key(1, "scene"))
    for name, method in record["methods"].items():
        episode = nbv.simulate(
            study.planner(name, scene), scene.surface, poses[record["first"]], 3, key, progress=False
        )
        assert method["coverage"] == coverage(episode.views, truth)
        for view, recorded in zip(episode.views, method["views"], strict=True):
            np.testing.assert_array_equal(view.pose.position, np.float32(recorded["position"]))
        cloud = replay(study, scene, method)[-1][1].cloud
        np.testing.assert_array_equal(cloud.points, episode.cloud.points)


def test_distances_are_those_of_the_reconstruction_from_the_last_cloud(record, meshes):
    study = small_study(meshes)
    scene = study.scene(1)
    truth = scene.surface.sample_points(jax.random.key(5), 20_000)
    sampler, method = study.mesher(scene).sampler, record["methods"]["farthest"]
    observations = replay(study, scene, method)[-1][1]
    for name, distances in method["reconstructions"].items():
        if distances is not None:
            points = reconstruct(sampler, observations, name).sample_points(jax.random.key(6), 20_000)
            expected = surface_distance(points, truth)
            assert distances["chamfer"] == pytest.approx(expected.chamfer, rel=0.05)
            assert distances["hausdorff"] == pytest.approx(expected.hausdorff, rel=0.1)


def test_without_pymeshlab_the_mean_alone_is_measured(monkeypatch, meshes):
    monkeypatch.setattr(reconstruction, "has_poisson", lambda: False)
    distances = run_scene(small_study(meshes), 1, ("farthest",))["methods"]["farthest"]["reconstructions"]
    assert distances[POISSON] is None
    assert distances[MEAN]["chamfer"] > 0


def test_procedural_scenes_differ_and_are_named():
    study = small_study()
    first, second = study.scene(0), study.scene(1)
    assert (first.name, second.name) == ("airplane 0", "bag 1")
    x = np.random.default_rng(0).uniform(-1.25, 1.25, (50, 3))
    assert first.surface.in_jit
    assert np.abs(np.asarray(first.surface.sdf(x) - second.surface.sdf(x))).max() > 0.1


def test_mesh_files_are_sorted_and_what_cannot_be_read_is_named(meshes, tmp_path):
    study = small_study(meshes)
    assert [study.scene(index).name for index in (0, 1)] == ["a_box", "b_torus"]
    np.testing.assert_allclose(np.ptp(study.scene(0).surface.vertices, axis=0), [2.5 / 3, 5 / 3, 2.5])
    with pytest.raises(InputError, match="no scene 2: the study has 2 meshes"):
        study.scene(2)
    with pytest.raises(InputError, match="holds no mesh"):
        mesh_files(tmp_path)
    with pytest.raises(InputError, match="no folder"):
        mesh_files(tmp_path / "missing")
    (tmp_path / "broken.ply").write_bytes(b"not a mesh")
    with pytest.raises(InputError, match=r"cannot read .*broken\.ply"):
        run_scene(small_study(tmp_path), 0)


def test_the_pictures_show_something(record, meshes, tmp_path, monkeypatch):
    monkeypatch.setattr(reconstruction, "_NUM_DENSE_POINTS", 2000)
    folder = tmp_path / "pictures"
    (picture,) = write_pictures([record], small_study(meshes), folder, pixels=80)
    assert picture.name == "scene_0001.png"
    # The truth and two methods side by side.
    image = np.asarray(Image.open(picture).convert("L"))
    assert image.std() > 5
    for strip in np.array_split(image[:, 100:], 3, axis=1):
        assert strip.std() > 5


def test_a_reconstruction_that_no_scene_has_is_left_out():
    distances = {"chamfer": 0.3, "accuracy": 0.1, "completeness": 0.2, "hausdorff": 0.4}

    def record(scene, poisson):
        run = {"coverage": [0.25, 0.5 + 0.1 * scene], "reconstructions": {POISSON: poisson, MEAN: distances}}
        return {"scene": scene, "methods": {"coverage": run, "farthest": run}}

    records = [record(0, None), record(1, distances)]
    table = results(records, ReconstructionStudy).set_index(["at", "quantity", "method"]).sort_index()
    means = [table.loc[way, "chamfer", "farthest"] for way in (MEAN, POISSON)]
    assert [(row["mean"], row["scenes"]) for row in means] == [(pytest.approx(0.3), 2), (pytest.approx(0.3), 1)]
    assert table.loc[(2, "covered", "farthest"), "mean"] == pytest.approx(0.55)
    # Without a scene that has it, the table's column is missing, and the note says how to get it.
    for kept, has_column in ((records, True), (records[:1], False)):
        lines = summary(results(kept, ReconstructionStudy), ReconstructionStudy).splitlines()
        assert any(line.startswith("reconstruction ") and POISSON in line for line in lines) == has_column
