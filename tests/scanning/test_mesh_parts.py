"""Meshes whose nodes are parts, against boxes' own distances."""

import numpy as np
import pytest
import trimesh

from jaxnbv.checks import InputError
from jaxnbv.scanning import Grid, load_mesh, load_parts

# A slab that stands on a post: the whole is 4 wide and 3 high.
BOXES = {"post": ((0.0, 1.0, 0.0), (1.0, 2.0, 1.0)), "slab": ((0.5, 2.5, 0.0), (4.0, 1.0, 2.0))}


def saved(path, boxes=BOXES):
    scene = trimesh.Scene()
    for name, (center, extents) in boxes.items():
        placed = trimesh.transformations.translation_matrix(center)
        scene.add_geometry(trimesh.creation.box(extents), node_name=name, transform=placed)
    scene.export(path)
    return path


def box_distance(x, center, extents):
    """From points to the surface of a box."""
    beyond = np.abs(x - center) - 0.5 * np.asarray(extents)
    outside = np.linalg.norm(np.maximum(beyond, 0.0), axis=-1)
    return np.where((beyond <= 0).all(axis=-1), -beyond.max(axis=-1), outside)


def test_parts_are_the_nodes_where_the_whole_has_them(tmp_path):
    found = load_parts(saved(tmp_path / "table.glb"))
    whole = load_mesh(tmp_path / "table.glb")
    assert found.names == ("post", "slab")
    joined = np.concatenate([part.vertices for part in found.parts])
    np.testing.assert_allclose(np.sort(joined, axis=0), np.sort(found.mesh.vertices, axis=0), atol=1e-6)
    np.testing.assert_array_equal(found.mesh.vertices, whole.vertices)
    # Longest side 4, now 2.5; the box around both is centred at (0.5, 1.5, 0).
    expected = (np.array([0.0, 1.0, 0.0]) - [0.5, 1.5, 0.0]) * 2.5 / 4
    np.testing.assert_allclose(found.parts[0].vertices.mean(axis=0), expected, atol=1e-6)


def test_distances_are_those_from_each_box(tmp_path):
    grid = Grid(9, 1.4)
    distances = np.asarray(load_parts(saved(tmp_path / "table.glb")).distances(grid))
    nodes = np.stack(np.meshgrid(grid.axis, grid.axis, grid.axis, indexing="ij"), axis=-1)
    for distance, (center, extents) in zip(distances, BOXES.values(), strict=True):
        expected = box_distance(nodes, (np.array(center) - [0.5, 1.5, 0.0]) * 0.625, np.array(extents) * 0.625)
        np.testing.assert_allclose(distance, expected, atol=1e-5)


def test_a_file_of_one_node_has_no_parts(tmp_path):
    path = saved(tmp_path / "slab.glb", {"slab": BOXES["slab"]})
    with pytest.raises(InputError, match=r"slab\.glb has one node"):
        load_parts(path)
