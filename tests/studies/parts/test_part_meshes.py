"""The study of parts on meshes, with a table that the test builds."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from jaxnbv.checks import InputError
from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.sampler import SurfaceSampler
from jaxnbv.scanning import Grid, load_parts
from jaxnbv.scanning.mesh_files import read_nodes
from jaxnbv.studies.engine.pictures import write_pictures
from jaxnbv.studies.engine.run import replay, run_scene
from jaxnbv.studies.parts import study as parts_study
from jaxnbv.studies.parts.discovery import NearestPart
from jaxnbv.studies.parts.study import MeshPartStudy, PartStudy
from jaxnbv.surfaces import GeometricSPSR

# In scene coordinates: the longest side is 2.5, and the box around all is centred. The hidden box is within the post.
BOXES = {
    "hidden": ((0.0, -0.4, 0.0), (0.2, 0.2, 0.2)),
    "post": ((0.0, -0.35, 0.0), (0.6, 1.3, 0.6)),
    "slab": ((0.0, 0.65, 0.0), (2.5, 0.7, 2.0)),
}


def save(path, names):
    path.parent.mkdir(exist_ok=True)
    scene = trimesh.Scene()
    for name in names:
        center, extents = BOXES[name]
        placed = trimesh.transformations.translation_matrix(center)
        scene.add_geometry(trimesh.creation.box(extents), node_name=name, transform=placed)
    scene.export(path)


@pytest.fixture
def folder(tmp_path):
    save(tmp_path / "bench" / "one.glb", ["slab"])
    save(tmp_path / "table" / "a.glb", ["hidden", "post", "slab"])
    save(tmp_path / "table" / "b.glb", ["post", "slab"])
    return tmp_path


def small_study(folder, **settings):
    sampler = SurfaceSampler(GeometricSPSR(lengthscale=0.05, truncation=8))
    small = {"views": 3, "num_candidates": 12, "num_samples": 2, "sampler": sampler, "grid_resolution": 20}
    limits = {"capacity": 1500, "camera": Camera(height=32, width=32), "imagined_rays": 12, "num_points": 100}
    return MeshPartStudy(meshes=MeshPartStudy.files_in(folder), room=3, **(small | limits | settings))


def test_files_of_one_node_are_passed_over(folder):
    files = MeshPartStudy.files_in(folder)
    assert [(file.name, file.path) for file in files] == [
        ("table a", str(folder / "table/a.glb")),
        ("table b", str(folder / "table/b.glb")),
    ]
    with pytest.raises(InputError, match="no mesh of two nodes or more"):
        MeshPartStudy.files_in(folder / "bench")


def test_points_belong_to_the_nearest_box(folder):
    oracle = NearestPart.of(load_parts(folder / "table/b.glb"), 4, Grid(64, 1.4), 200)
    points = np.random.default_rng(0).uniform(-1.2, 1.2, (200, 3))
    beyond = [np.abs(points - center) - 0.5 * np.array(extents) for center, extents in list(BOXES.values())[1:]]
    distance = np.stack([np.linalg.norm(np.maximum(b, 0), axis=1) + np.minimum(b.max(axis=1), 0) for b in beyond])
    # A linear interpolant errs by less than a cell.
    clear = np.abs(np.abs(distance[0]) - np.abs(distance[1])) > Grid(64, 1.4).spacing
    assert clear.sum() > 100
    nearest = np.argmin(np.abs(distance), axis=0)
    np.testing.assert_array_equal(np.asarray(oracle.nearest(jnp.asarray(points)))[clear], nearest[clear])
    mask = np.arange(200) < 150
    cloud = PointCloud(*map(jnp.asarray, (points, np.tile([0.0, 1.0, 0.0], (200, 1)), mask)))
    p = np.asarray(oracle(cloud))
    np.testing.assert_allclose(p.sum(axis=1), mask, atol=1e-5)
    assert (p[:, 2:] == 0).all()
    fed, parts = oracle.predict(cloud)
    np.testing.assert_array_equal(parts[:150], oracle.nearest(fed.points[:150]))
    assert (parts[150:] == -1).all()
    slope = jax.grad(lambda x: oracle(PointCloud(x, cloud.normals, cloud.mask))[:, 0].sum())(cloud.points)
    assert np.isfinite(slope).all()
    assert (slope[:150] != 0).any()


@pytest.mark.slow
def test_it_asks_for_the_parts_that_can_be_seen_and_counts_their_points(folder, tmp_path):
    study = small_study(folder)
    assert study.num_scenes == 2
    record = run_scene(study, 0, ("discrete", "farthest"))
    assert (record["name"], record["category"], record["of"]) == ("table a", "table", 3)
    assert record["parts"] == ["post", "slab"]
    scene = study.scene(0)
    for run in record["methods"].values():
        for counts, (_, observations) in zip(run["counts"], replay(study, scene, run), strict=True):
            points, _ = observations.cloud.to_numpy()
            # All surface above 0.3 is the slab's. Noise is 0.01.
            slab = (points[:, 1] > 0.25).sum()
            assert abs(counts[1] - slab) <= 0.03 * len(points)
            assert sum(counts) == len(points)
    (path,) = write_pictures([record], study, tmp_path / "out", pixels=24)
    assert path.read_bytes()[:4] == b"\x89PNG"
    with pytest.raises(InputError, match="there is no scene 2"):
        study.scene(2)


def test_the_command_takes_a_folder_and_reads_each_file_once(folder, monkeypatch):
    paths = []
    monkeypatch.setattr(parts_study, "read_nodes", lambda path: paths.append(path) or read_nodes(path))
    (study,) = PartStudy.configured("screened", 3, quick=True, meshes=folder).values()
    assert len(paths) == len(set(paths)) == 3
    assert isinstance(study, MeshPartStudy)
    assert study.room == 3
    assert study.num_candidates == PartStudy.quick["num_candidates"]
