"""Trucks and cargo from meshes, on a truck of boxes with a known bed."""

import igl
import jax
import numpy as np
import pytest
import trimesh

from jaxnbv.checks import InputError
from jaxnbv.scanning import TriangleMesh, scan
from jaxnbv.studies.classification.objects import TruckStudy
from jaxnbv.studies.scenes.truck_meshes import bed_of, loaded_truck

# The longest side is 2.5 and the truck is centred, so these are scene coordinates. The room on the bed is x -1.15 to
# 0.35, y -0.2 to 0.5, z -0.45 to 0.45.
TRUCK = {
    "chassis": ((0.0, -0.35, 0.0), (2.5, 0.3, 1.0)),
    "cab": ((0.8, 0.15, 0.0), (0.9, 0.7, 1.0)),
    "left": ((-0.45, 0.0, -0.475), (1.6, 0.4, 0.05)),
    "right": ((-0.45, 0.0, 0.475), (1.6, 0.4, 0.05)),
    "tail": ((-1.2, 0.0, 0.0), (0.1, 0.4, 1.0)),
}
# The foot is narrower than the top.
CARGO = {"foot": ((0.0, 0.2, 0.0), (0.3, 0.4, 0.3)), "top": ((0.0, 0.5, 0.0), (0.8, 0.2, 0.6))}


def boxes(parts):
    meshes = [
        trimesh.creation.box(extents, trimesh.transformations.translation_matrix(center))
        for center, extents in parts.values()
    ]
    return trimesh.util.concatenate(meshes)


def mesh(parts):
    joined = boxes(parts)
    return TriangleMesh.from_arrays(joined.vertices, joined.faces)


def test_the_bed_is_where_the_boxes_leave_it():
    # A cell is 2.5 / 96 long.
    np.testing.assert_allclose(bed_of(mesh(TRUCK)), [[-1.15, -0.2, -0.45], [0.35, 0.5, 0.45]], atol=0.027)


def test_what_has_no_bed_is_refused():
    with pytest.raises(InputError, match="has an open bed"):
        bed_of(mesh({"cab": TRUCK["cab"]}))


@pytest.mark.parametrize("seed", range(4))
def test_the_cargo_stands_on_the_bed_and_tells_the_class(seed):
    truck, cargo = mesh(TRUCK), mesh(CARGO)
    thing = loaded_truck(truck, cargo, 7, jax.random.key(seed))
    assert thing.label == 7
    corners = thing.mesh.vertices
    np.testing.assert_allclose(np.ptp(corners, axis=0).max(), 2.5)
    own, others = corners[len(truck.vertices) :], corners[: len(truck.vertices)]
    np.testing.assert_allclose(own, thing.cue.vertices, atol=1e-9)
    # Truck and cargo are rotated and scaled together: all distances change by the same factor.
    for before, after in ((truck.vertices, others), (cargo.vertices, own)):
        ratio = np.linalg.norm(after[1:] - after[0], axis=1) / np.linalg.norm(before[1:] - before[0], axis=1)
        np.testing.assert_allclose(ratio, ratio[0])
    # The cargo touches the floor, and no part of it is within the truck.
    distance = np.sqrt(igl.point_mesh_squared_distance(own, others, truck.faces)[0])
    assert distance.min() < 0.01
    inside = igl.fast_winding_number(others, truck.faces, own + 1e-3 * (own.mean(axis=0) - own))
    assert (inside < 0.5).all()
    assert thing.on_cue(own).all()
    assert not thing.on_cue(others).any()


def test_the_study_counts_the_rays_that_hit_the_cargo(tmp_path):
    for folder, parts in (("trucks", TRUCK), ("table", CARGO)):
        (tmp_path / folder).mkdir()
        boxes(parts).export(tmp_path / folder / "one.ply")
    settings = {"num_candidates": 8}
    (study,) = TruckStudy.configured("screened", 2, False, meshes=tmp_path, **settings).values()
    assert study.num_scenes == 1
    scene = study.scene(0)
    assert scene.name == "table one"
    assert scene.task.label == study.objects.classes.index("table")
    # Hits in front of the truck alone, or beside it, are on the cargo.
    faces = scene.surface.faces[: len(boxes(TRUCK).faces)]
    alone = TriangleMesh(scene.surface.vertices, faces, scene.surface.frame)
    poses = study.candidates.poses()
    both, empty = (scan(surface, study.camera, poses) for surface in (scene.surface, alone))
    nearer = np.linalg.norm(np.asarray(both.points) - np.asarray(empty.points), axis=-1) > 3e-3
    counts = (np.asarray(both.mask) & (nearer | ~np.asarray(empty.mask))).sum(axis=1)
    # Where cargo meets the floor a ray may hit either.
    np.testing.assert_allclose(scene.task.cue_pixels, counts, atol=8)
    assert counts.max() > 150
    with pytest.raises(InputError, match=r"there is no folder .*trucks"):
        TruckStudy.configured("screened", 2, False, meshes=tmp_path / "table")
