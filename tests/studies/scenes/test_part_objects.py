"""Procedural part-labelled objects: every part shows, stands where it belongs, and hangs together with the rest."""

import functools

import equinox as eqx
import jax
import numpy as np
import pytest
import trimesh
from solids import check_fills_its_box, check_whole, mesh_of, thinnest

from jaxnbv.networks.categories import CATEGORIES, category_index
from jaxnbv.studies.scenes import PART_CATEGORIES, Split, part_scene

COMPUTES = True


@eqx.filter_jit
def labels_at(solid, x):
    return solid.label(x)


def part_object(category, turn):
    return part_scene(Split.VALIDATION, PART_CATEGORIES.index(category) + turn * len(PART_CATEGORIES)).solid


@functools.cache
def objects(category):
    solids = [part_object(category, turn) for turn in (1, 2)]
    return [(solid, mesh_of(solid)) for solid in solids]


def present(solid):
    return {int(label) for label in solid.labels if label >= 0}


def surface_labels(solid, mesh):
    points, _ = trimesh.sample.sample_surface(mesh, 6000, seed=0)
    return points, np.asarray(labels_at(solid, points.astype(np.float32)))


@pytest.mark.parametrize("category", PART_CATEGORIES)
def test_every_part_shows_and_no_other(category):
    parts = CATEGORIES[category_index(category)].labels
    for solid, mesh in objects(category):
        shown, share = np.unique(surface_labels(solid, mesh)[1], return_counts=True)
        assert set(shown.tolist()) == present(solid) <= set(parts)
        assert share.min() >= 0.015 * 6000
        assert len(shown) >= 2


@pytest.mark.parametrize("category", PART_CATEGORIES)
def test_objects_are_whole_fill_their_box_and_have_no_thin_part(category):
    for _, mesh in objects(category):
        check_whole(mesh)
        check_fills_its_box(mesh)
    assert min(thinnest(part_object(category, turn)) for turn in range(6)) >= 0.05


# Part, axis, and the part that stands further along it.
ORDER = {
    "airplane": [("tail", 0, "wing"), ("body", 1, "tail")],
    "bag": [("body", 1, "handle")],
    "chair": [("back", 0, "seat"), ("leg", 1, "seat"), ("seat", 1, "back")],
    "earphone": [("ear cup", 1, "headband")],
    "guitar": [("body", 1, "neck"), ("neck", 1, "head")],
    "laptop": [("screen", 0, "keyboard"), ("keyboard", 1, "screen")],
    "motorbike": [("seat", 0, "gas tank"), ("gas tank", 0, "handles"), ("wheel", 1, "seat"), ("frame", 1, "light")],
    "pistol": [("handle", 0, "trigger"), ("trigger", 1, "barrel")],
    "rocket": [("fin", 1, "body"), ("body", 1, "nose")],
    "skateboard": [("wheel", 1, "truck"), ("truck", 1, "deck")],
    "table": [("leg", 1, "top")],
}


@pytest.mark.parametrize("category", ORDER)
def test_objects_stand_upright_and_face_x(category):
    kind = CATEGORIES[category_index(category)]
    label = dict(zip(kind.parts, kind.labels, strict=True))
    for solid, mesh in objects(category):
        points, labels = surface_labels(solid, mesh)
        for part, axis, further in ORDER[category]:
            if label[part] in present(solid) and label[further] in present(solid):
                middles = [points[labels == label[name], axis].mean() for name in (part, further)]
                assert middles[0] < middles[1], (part, further)


def test_there_are_variants_with_and_without_optional_parts():
    for category, part in (("chair", 15), ("table", 49), ("earphone", 18), ("lamp", 26)):
        solids = [part_object(category, turn) for turn in range(16)]
        assert 0 < sum(part in present(solid) for solid in solids) < 16
        assert len({int((solid.labels >= 0).sum()) for solid in solids}) > 1


def parameters(solid):
    return np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(solid)])


def test_categories_take_turns_and_no_two_scenes_are_the_same_in_any_split():
    count, seen = 2 * len(PART_CATEGORIES), []
    for split in Split:
        for index in range(count):
            scene = part_scene(split, index)
            assert CATEGORIES[int(scene.category)].name == PART_CATEGORIES[index % len(PART_CATEGORIES)]
            assert set(np.flatnonzero(scene.parts).tolist()) == present(scene.solid)
            seen.append(parameters(scene.solid))
    assert len(np.unique(np.stack(seen).round(4), axis=0)) == 3 * count
    np.testing.assert_array_equal(parameters(part_scene(Split.TEST, count - 1).solid), seen[-1])
