"""The reconstruction study on a small scale; tables and figures from records made by hand."""

import csv
import json

import jax
import numpy as np
import pytest
import trimesh
from PIL import Image

import jaxnbv as nbv
from jaxnbv.checks import InputError
from jaxnbv.experiments.meshes import mesh_files
from jaxnbv.experiments.metrics import coverage, truth_points
from jaxnbv.experiments.reconstruction import pictures as reconstruction_pictures
from jaxnbv.experiments.reconstruction import study as reconstruction_study
from jaxnbv.experiments.reconstruction.distances import surface_distance
from jaxnbv.experiments.reconstruction.figures import write_figures
from jaxnbv.experiments.reconstruction.pictures import write_pictures
from jaxnbv.experiments.reconstruction.report import (
    difference_rows,
    distance_rows,
    methods_of,
    summary_table,
    write_tables,
)
from jaxnbv.experiments.reconstruction.study import (
    MEAN,
    METHODS,
    POISSON,
    ReconstructionStudy,
    reconstruct,
    run_scene,
    seen_cloud,
)
from jaxnbv.experiments.records import RecordFolder
from jaxnbv.reconstruction import has_poisson
from jaxnbv.scanning import scan
from jaxnbv.search.candidates import sphere_candidates
from jaxnbv.storage import describe

# Those that draw no samples compile in a fraction of the time; all planners are of the same make.
RUN = ("farthest", "random")
CANDIDATES = 10
HAS_POISSON = has_poisson()


@pytest.fixture(scope="module")
def meshes(tmp_path_factory):
    """A folder with two objects and files that belong to them."""
    folder = tmp_path_factory.mktemp("meshes")
    trimesh.creation.torus(1.0, 0.4, 40, 20).export(folder / "b_torus.OBJ", file_type="obj")
    trimesh.creation.box((1.0, 2.0, 3.0)).export(folder / "a_box.ply")
    (folder / "readme.md").write_text("objects")
    (folder / "b_torus.mtl").write_text("newmtl material_0")
    return folder


def small_study(meshes=None, views=3, **settings):
    model = nbv.GeometricSPSR(lengthscale=0.05, truncation=8)
    small = {"num_candidates": CANDIDATES, "num_samples": 2, "model": model, "grid_resolution": 20, "capacity": 250}
    return ReconstructionStudy(mesh_files(meshes) if meshes else (), views=views, **(small | settings))


_records: dict = {}


@pytest.fixture
def record(meshes):
    if not _records:
        _records["torus"] = run_scene(small_study(meshes), 1, RUN)
    return _records["torus"]


def test_a_record_is_json_and_holds_every_method(record):
    assert json.loads(json.dumps(record, allow_nan=False)) == record
    assert (record["scene"], record["name"]) == (1, "b_torus.OBJ")
    assert list(record["methods"]) == list(RUN)
    assert METHODS == ("coverage", "farthest", "uncertainty", "random")
    for method in record["methods"].values():
        assert method["candidates"][0] == record["first"]
        assert len(set(method["candidates"])) == 3
        assert set(method["candidates"]) <= set(range(CANDIDATES))
        assert 0 < method["coverage"][0] < method["coverage"][-1] <= 1
        assert 0 < method["points"] <= 250
        for name, found in method["reconstructions"].items():
            if name == POISSON and not HAS_POISSON:
                assert found is None
                continue
            assert found["chamfer"] == found["accuracy"] + found["completeness"]
            assert 0 < found["chamfer"] < 2 * found["hausdorff"]


def test_a_scene_can_be_run_again_with_some_of_the_methods(record, meshes):
    again = run_scene(small_study(meshes), 1, ("random",))
    assert list(again["methods"]) == ["random"]
    for name, method in again["methods"].items():
        assert method == record["methods"][name]


def test_planners_differ_in_their_search_alone():
    study = small_study()
    searches = (nbv.DiscreteSearch, nbv.FarthestView, nbv.UncertaintyView, nbv.RandomView)
    for method, search in zip(METHODS, searches, strict=True):
        planner = study.planner(method)
        assert planner.search == search(CANDIDATES)
        assert describe(planner) | {"search": None} == describe(study.planner("farthest")) | {"search": None}
    assert isinstance(planner.acquisition, nbv.Coverage)
    assert (planner.num_samples, planner.grid, planner.capacity, planner.max_views) == (2, nbv.Grid(20), 250, 3)


def test_views_are_those_of_an_episode_from_the_shared_first_view(record, meshes):
    study = small_study(meshes)
    scene, poses = study.scene(1), sphere_candidates(CANDIDATES)
    assert bool(scan(scene, nbv.Camera(), poses[record["first"]]).mask.any())
    key = reconstruction_study._key(1, "episode")
    truth = truth_points(scene, reconstruction_study._key(1, "truth"))
    for name, method in record["methods"].items():
        episode = nbv.simulate(study.planner(name), scene, poses[record["first"]], 3, key, progress=False)
        for view, candidate, share in zip(episode.views, method["candidates"], method["coverage"], strict=True):
            np.testing.assert_array_equal(view.pose.position, poses[candidate].position)
            assert share == coverage(view.cloud, truth)
        cloud = seen_cloud(study, 1, method["candidates"])
        np.testing.assert_array_equal(cloud.points, episode.cloud.points)


def test_distances_are_those_of_the_reconstruction_from_the_last_cloud(record, meshes):
    study = small_study(meshes)
    truth = study.scene(1).sample_points(jax.random.key(5), 20_000)
    method = record["methods"]["farthest"]
    cloud = seen_cloud(study, 1, method["candidates"])
    for name, found in method["reconstructions"].items():
        if found is not None:
            points = reconstruct(study, cloud, name).sample_points(jax.random.key(6), 20_000)
            expected = surface_distance(points, truth)
            assert found["chamfer"] == pytest.approx(expected.chamfer, rel=0.05)
            assert found["hausdorff"] == pytest.approx(expected.hausdorff, rel=0.1)


def test_without_pymeshlab_the_mean_alone_is_measured(monkeypatch, meshes):
    monkeypatch.setattr(reconstruction_study, "has_poisson", lambda: False)
    found = run_scene(small_study(meshes), 1, ("farthest",))["methods"]["farthest"]["reconstructions"]
    assert found[POISSON] is None
    assert found[MEAN]["chamfer"] > 0


def test_procedural_scenes_differ_and_are_named():
    study = small_study()
    first, second = study.scene(0), study.scene(1)
    assert (study.name(0), study.name(1)) == ("airplane 0", "bag 1")
    x = np.random.default_rng(0).uniform(-1.25, 1.25, (50, 3))
    assert first.in_jit
    assert np.abs(np.asarray(first.sdf(x) - second.sdf(x))).max() > 0.1


def test_mesh_files_are_sorted_and_what_cannot_be_read_is_named(meshes, tmp_path):
    study = small_study(meshes)
    assert [study.name(index) for index in (0, 1)] == ["a_box.ply", "b_torus.OBJ"]
    np.testing.assert_allclose(np.ptp(study.scene(0).vertices, axis=0), [2.5 / 3, 5 / 3, 2.5])
    with pytest.raises(InputError, match="no scene 2: the study has 2 meshes"):
        study.scene(2)
    with pytest.raises(InputError, match="holds no mesh"):
        mesh_files(tmp_path)
    with pytest.raises(InputError, match="no folder"):
        mesh_files(tmp_path / "missing")
    (tmp_path / "broken.ply").write_bytes(b"not a mesh")
    with pytest.raises(InputError, match=r"cannot read .*broken\.ply"):
        run_scene(small_study(tmp_path), 0)


def test_bad_settings_are_refused(meshes):
    for settings in ({"views": 1}, {"views": 11}):
        with pytest.raises(InputError, match="at least two views"):
            small_study(**settings)
    with pytest.raises(InputError, match="unknown methods: heat; choose from coverage"):
        run_scene(small_study(meshes), 0, ("heat", "random"))
    with pytest.raises(InputError, match="no views"):
        seen_cloud(small_study(meshes), 0, [])


def test_an_interrupted_study_goes_on(record, meshes, tmp_path):
    asked = []

    def run(index):
        asked.append(index)
        return record | {"scene": index}

    config = {"study": describe(small_study(meshes))}
    RecordFolder(tmp_path, config).collect(1, run, progress=False)
    found = RecordFolder(tmp_path, config).collect(2, run, progress=False)
    assert asked == [0, 1]
    assert found == [record | {"scene": 0}, record]
    for other in (small_study(meshes, views=4), small_study()):
        with pytest.raises(InputError, match="another study"):
            RecordFolder(tmp_path, {"study": describe(other)})


def found(accuracy, completeness, hausdorff):
    both = accuracy + completeness
    return {"chamfer": both, "accuracy": accuracy, "completeness": completeness, "hausdorff": hausdorff}


def made_record(scene, **methods):
    """Of each method the distances of Poisson reconstruction and of the mean."""
    return {"scene": scene, "name": f"object {scene}", "first": 0, "seconds": 1.0} | {
        "methods": {
            name: {
                "candidates": [0, 1],
                "coverage": [0.25, 0.5 + 0.1 * scene],
                "points": 100,
                "reconstructions": {POISSON: poisson, MEAN: mean},
            }
            for name, (poisson, mean) in methods.items()
        }
    }


def hand_made():
    return [
        made_record(0, farthest=(None, found(0.1, 0.1, 0.5)), coverage=(None, found(0.05, 0.05, 0.6))),
        made_record(
            1,
            farthest=(found(0.1, 0.2, 0.4), found(0.2, 0.2, 0.9)),
            coverage=(found(0.1, 0.1, 0.5), found(0.1, 0.2, 0.8)),
        ),
    ]


def test_rows_are_means_with_standard_errors_over_the_scenes_that_have_them():
    rows = {(row["reconstruction"], row["quantity"], row["method"]): row for row in distance_rows(hand_made())}
    assert len(rows) == 2 * 4 * 2
    row = rows[MEAN, "chamfer", "farthest"]
    assert (row["mean"], row["scenes"], row["best"]) == (pytest.approx(0.3), 2, False)
    # Of 0.2 and 0.4: a standard deviation of 0.1414, over the root of two.
    assert row["standard_error"] == pytest.approx(0.1)
    assert (row["low"], row["high"]) == (pytest.approx(0.2), pytest.approx(0.4))
    assert rows[MEAN, "chamfer", "coverage"]["mean"] == pytest.approx(0.2)
    assert rows[MEAN, "chamfer", "coverage"]["best"]
    assert rows[MEAN, "hausdorff", "farthest"]["mean"] == pytest.approx(0.7)
    poisson = rows[POISSON, "hausdorff", "farthest"]
    assert (poisson["mean"], poisson["scenes"], poisson["best"]) == (pytest.approx(0.4), 1, True)
    assert np.isnan(poisson["standard_error"])


def test_differences_are_paired():
    rows = {(row["reconstruction"], row["quantity"]): row for row in difference_rows(hand_made())}
    row = rows[MEAN, "chamfer"]
    assert (row["method"], row["baseline"], row["mean"]) == ("coverage", "farthest", pytest.approx(-0.1))
    # Both scenes differ by -0.1, so any resample does; the Hausdorff distances by 0.1 and -0.1.
    assert (row["low"], row["high"], row["excludes_zero"]) == (pytest.approx(-0.1), pytest.approx(-0.1), True)
    assert rows[MEAN, "hausdorff"]["mean"] == pytest.approx(0.0, abs=1e-12)
    assert not rows[MEAN, "hausdorff"]["excludes_zero"]
    assert difference_rows([made_record(0, farthest=(None, found(1.0, 1.0, 1.0)))]) == []


def test_the_text_and_the_files_hold_the_table(tmp_path):
    records = hand_made()
    text = summary_table(records)
    assert f"{POISSON}: 1 scene\n" in text
    assert f"{MEAN}: 2 scenes\n" in text
    lines = text.splitlines()
    after = lines.index(f"{MEAN}: 2 scenes")
    (ours,) = [line.split() for line in lines[after : after + 6] if line.startswith("  coverage  ")]
    assert ours[1:4] == ["0.200", "+-", "0.100*"]
    assert "-0.100 [-0.100, -0.100]*" in text
    assert " 55 [ 50,  60]" in text
    paths = write_tables(records, tmp_path / "tables")
    assert paths[0].read_text() == text
    results, differences, covered = (list(csv.DictReader(path.open())) for path in paths[1:])
    assert (len(results), len(differences), len(covered)) == (16, 8, 4)
    assert {row["mean"] for row in results if row["quantity"] == "chamfer"} == {"0.3", "0.2"}
    without = summary_table(records[:1])
    assert f"{POISSON}: no scene has it" in without


def test_records_that_do_not_go_together_are_refused():
    with pytest.raises(InputError, match="no records"):
        methods_of([])
    records = hand_made()
    records[1]["methods"]["coverage"]["candidates"] = [0, 1, 2]
    with pytest.raises(InputError, match="number of views"):
        methods_of(records)
    one, other = (made_record(0, **{name: (None, None)}) for name in ("random", "coverage"))
    with pytest.raises(InputError, match="in common"):
        methods_of([one, other])


def test_the_chart_and_the_pictures_show_something(record, meshes, tmp_path, monkeypatch):
    monkeypatch.setattr(reconstruction_pictures, "_PIXELS", 80)
    monkeypatch.setattr(reconstruction_pictures, "_DENSE", 2000)
    path = write_figures(hand_made(), tmp_path / "figures")
    (picture,) = write_pictures([record], small_study(meshes), tmp_path / "figures")
    assert picture.name == "surfaces_001.png"
    for file in (path, picture):
        with Image.open(file) as image:
            assert np.asarray(image.convert("L")).std() > 5
    # The truth and two methods, side by side.
    image = np.asarray(Image.open(picture).convert("L"))
    for strip in np.array_split(image[:, 100:], 3, axis=1):
        assert strip.std() > 5
