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
from jaxnbv.scanning.metrics import coverage, surface_distance, truth_points
from jaxnbv.scanning.screened_poisson import has_poisson
from jaxnbv.storage import describe
from jaxnbv.studies import reconstruction
from jaxnbv.studies.engine.pictures import write_pictures
from jaxnbv.studies.engine.results import results, summary
from jaxnbv.studies.engine.run import replay, run_scene
from jaxnbv.studies.reconstruction import MEAN, POISSON, ReconstructionStudy, reconstruct

# Methods without samples compile in a fraction of the time. All planners have the same structure.
RUN = ("farthest", "random")
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


def small_study(folder=None):
    sampler = SurfaceSampler(nbv.GeometricSPSR(lengthscale=0.05, truncation=8))
    small = {"num_candidates": 10, "num_samples": 2, "grid_resolution": 20, "capacity": 250}
    return ReconstructionStudy(meshes=mesh_files(folder) if folder else (), views=3, sampler=sampler, **small)


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


def test_the_measures_are_of_the_views_and_of_the_last_cloud(record, meshes):
    """The same views by `simulate`. Distances are to other points of both surfaces than the study's."""
    study, run = small_study(meshes), record["methods"]["farthest"]
    scene, observations = study.scene(1), replay(study, study.scene(1), run)[-1][1]
    first = study.candidates.poses()[record["first"]]
    planner, key = study.planner("farthest", scene), study.key(1, "episode")
    episode = nbv.simulate(planner, scene.surface, first, 3, key, progress=False)
    assert run["coverage"] == coverage(episode.views, truth_points(scene.surface, study.key(1, "scene")))
    np.testing.assert_array_equal(observations.cloud.points, episode.cloud.points)
    truth = scene.surface.sample_points(jax.random.key(5), 20_000)
    for name, distances in run["reconstructions"].items():
        if distances is not None:
            mesh = reconstruct(study.mesher(scene).sampler, observations, name)
            expected = surface_distance(mesh.sample_points(jax.random.key(6), 20_000), truth)
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
    (picture,) = write_pictures([record], small_study(meshes), tmp_path, pixels=80)
    assert picture.name == "scene_0001.png"
    # The truth and two methods side by side.
    image = np.asarray(Image.open(picture).convert("L"))
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
