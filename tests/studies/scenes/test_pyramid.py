"""The synthetic pyramid against polygons, closed-form volumes and points placed on its faces by hand."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.path import Path as Polygon

from jaxnbv.checks import InputError
from jaxnbv.geometry.camera import Camera
from jaxnbv.scanning import Grid, SDFSurface, mesh_from_sdf, scan
from jaxnbv.scanning.sdf.imprinted import ImprintedPyramid, pattern_distance
from jaxnbv.search.candidates import sphere_candidates
from jaxnbv.studies.scenes import PATTERNS, Framing, Split, hidden_view, pyramid_scene

RNG = np.random.default_rng(0)
CAMERA = Camera(height=24, width=24)

values = eqx.filter_jit(lambda sdf, x: sdf(x))
on_cue = eqx.filter_jit(lambda pyramid, x: pyramid.on_cue(x))


def polar(radii, degrees):
    return np.stack([radii * np.cos(np.radians(degrees)), radii * np.sin(np.radians(degrees))], axis=-1)


def arms():
    a, b = 0.95, 0.3
    quarter = np.array([[b, b], [b, a], [-b, a]])
    return np.concatenate([quarter @ np.array([[c, s], [-s, c]]) for c, s in ((1, 0), (0, 1), (-1, 0), (0, -1))])


# Corners of each outline, a closed polygon. The second outline of the ring is its hole.
OUTLINES = {
    "cross": [arms()],
    "ring": [polar(0.98, np.arange(0, 360, 0.25)), polar(0.5, np.arange(0, 360, 0.25))],
    "star": [polar(np.tile([1.0, 0.48], 5), 90 + 36 * np.arange(10))],
    "triangle": [polar(1.0, np.array([90, 210, 330]))],
    "square": [polar(0.7 * np.sqrt(2), np.array([45, 135, 225, 315]))],
}
AREAS = {
    "cross": 2 * 1.9 * 0.6 - 0.6**2,
    "ring": np.pi * (0.98**2 - 0.5**2),
    "star": 5 * 0.48 * np.sin(np.pi / 5),
    "triangle": 0.75 * np.sqrt(3),
    "square": 1.4**2,
}


def is_inside(name, points):
    return np.logical_xor.reduce([Polygon(outline).contains_points(points) for outline in OUTLINES[name]])


def edges(name):
    return [np.concatenate([o[:, None], np.roll(o, -1, axis=0)[:, None]], axis=1) for o in OUTLINES[name]]


def distance_to_outline(name, points):
    nearest = np.full(len(points), np.inf)
    for start, end in np.concatenate(edges(name)):
        along = np.clip((points - start) @ (end - start) / np.sum((end - start) ** 2), 0.0, 1.0)
        nearest = np.minimum(nearest, np.linalg.norm(points - start - along[:, None] * (end - start), axis=1))
    return nearest


def on_outline(name, count):
    """Points on the outline."""
    start, end = np.moveaxis(np.concatenate(edges(name)), 1, 0)
    length = np.linalg.norm(end - start, axis=1)
    chosen = RNG.choice(len(start), count, p=length / length.sum())
    return start[chosen] + RNG.random((count, 1)) * (end - start)[chosen]


@pytest.mark.parametrize("name", PATTERNS)
def test_patterns_against_polygons(x64, name):
    label, tolerance = jnp.asarray(PATTERNS.index(name)), 2e-5 if name == "ring" else 1e-12
    points = RNG.uniform(-1.4, 1.4, (4000, 2))
    value = np.asarray(pattern_distance(label, *jnp.asarray(points.T)))
    distance = distance_to_outline(name, points)
    np.testing.assert_array_equal((value < 0)[distance > tolerance], is_inside(name, points)[distance > tolerance])
    assert (np.abs(value) <= distance + tolerance).all()
    # The bound is tight: half of the distance at least, or its share at a tip of 49 degrees.
    assert (np.abs(value) >= 0.4 * distance - tolerance).all()
    edge = on_outline(name, 500)
    assert np.abs(np.asarray(pattern_distance(label, *jnp.asarray(edge.T)))).max() < tolerance
    assert np.linalg.norm(edge, axis=1).max() <= 1 + 1e-12


def to_scene(pyramid, own):
    rotation = np.asarray(pyramid.solid.rotation, np.float64)
    return float(pyramid.solid.scale) * np.asarray(own) @ rotation.T + np.asarray(pyramid.solid.offset, np.float64)


def of_pattern(pyramid, flat):
    """From the plane of the pattern to the plane of the base."""
    turn, size = float(pyramid.solid.turn), float(pyramid.solid.size)
    c, s = np.cos(turn), np.sin(turn)
    return size * flat @ np.array([[c, s], [-s, c]]) + np.asarray(pyramid.solid.place, np.float64)


def name_of(pyramid):
    return PATTERNS[int(pyramid.label)]


def test_the_mesh_lies_on_the_surface_and_holds_the_pyramid_less_its_imprint():
    for index, framing in enumerate(Framing):
        pyramid = pyramid_scene(Split.VALIDATION, index, framing)
        plain = eqx.tree_at(lambda p: p.solid.depth, pyramid, jnp.asarray(0.0))
        grid = Grid(100, 0.52 * framing.longest_side)
        mesh, whole = (mesh_from_sdf(sdf, grid).to_trimesh() for sdf in (pyramid, plain))
        assert np.abs(np.asarray(values(pyramid, mesh.vertices))).max() < 0.6 * grid.spacing
        assert np.median(np.abs(np.asarray(values(pyramid, mesh.vertices)))) < 1e-2 * grid.spacing
        scale, height, size = (float(v) for v in (pyramid.solid.scale, pyramid.solid.height, pyramid.solid.size))
        assert mesh.is_watertight
        assert whole.volume == pytest.approx(scale**3 * 4 * height / 3, rel=3e-3)
        imprint = scale**3 * AREAS[name_of(pyramid)] * size**2 * float(pyramid.solid.depth)
        assert whole.volume - mesh.volume == pytest.approx(imprint, rel=0.03)


@pytest.mark.parametrize("framing", list(Framing))
def test_the_longest_side_of_the_box_is_as_asked_and_the_box_is_centred(framing):
    for index in range(8):
        pyramid = pyramid_scene(Split.TRAIN, index, framing)
        corners = [[1, 1, 0], [1, -1, 0], [-1, -1, 0], [-1, 1, 0], [0, 0, float(pyramid.solid.height)]]
        corners = to_scene(pyramid, corners)
        np.testing.assert_allclose(np.asarray(values(pyramid, corners)), 0.0, atol=2e-6)
        low, high = corners.min(axis=0), corners.max(axis=0)
        assert (high - low).max() == pytest.approx(framing.longest_side, rel=1e-5)
        np.testing.assert_allclose(low + high, 0.0, atol=1e-5)


def test_slopes_are_at_most_one(x64):
    for index in range(10):
        pyramid = pyramid_scene(Split.TRAIN, index, list(Framing)[index // 5])
        x = RNG.uniform(-1.5, 1.5, (4000, 3))
        y = x + RNG.normal(size=x.shape) * 10.0 ** RNG.uniform(-3, 0.3, (len(x), 1))
        change = np.abs(np.asarray(values(pyramid, x)) - np.asarray(values(pyramid, y)))
        assert (change <= np.linalg.norm(x - y, axis=1) * (1 + 1e-9)).all()
        assert change.max() > 0.1


def scenes(split, count, framing=Framing.CLOSE_UP):
    build = jax.jit(jax.vmap(lambda index: pyramid_scene(split, index, framing)))
    return build(jnp.arange(count))


def test_no_pattern_breaks_through_a_side_and_none_reaches_the_apex():
    """The upper rim of the prism is nearest to the sides. Over many scenes the wall is at least 0.01 of the base."""
    pyramids = scenes(Split.TRAIN, 2000)
    for index in range(2000):
        pyramid = jax.tree.map(lambda leaf, index=index: np.asarray(leaf)[index], pyramids)
        corners = np.concatenate(OUTLINES[PATTERNS[int(pyramid.solid.pattern)]])
        reach = np.abs(of_pattern(pyramid, corners)).max()
        assert reach < 0.9 + 1e-6
        assert 1.0 - pyramid.solid.depth / pyramid.solid.height - reach > 0.01
        assert 0 < 3 * pyramid.solid.depth < pyramid.solid.height


def clear_of_outline(name, local, count, points=None):
    """The first of the points, also given in the pattern's frame, that are not near its outline."""
    some = slice(5 * count)
    return (local if points is None else points)[some][distance_to_outline(name, local[some]) > 0.03][:count]


def faces(pyramid, count=400):
    """Points in the pyramid's own frame on floor, wall, base and sides, none within 0.01 of an edge."""
    name, height, depth = name_of(pyramid), float(pyramid.solid.height), float(pyramid.solid.depth)
    flat = RNG.uniform(-1, 1, (20 * count, 2))
    floor = clear_of_outline(name, flat[is_inside(name, flat)], count)
    floor = np.insert(of_pattern(pyramid, floor), 2, depth, axis=1)
    wall = of_pattern(pyramid, on_outline(name, count))
    wall = np.insert(wall, 2, RNG.uniform(0.012, depth, count), axis=1)
    base = RNG.uniform(-0.99, 0.99, (20 * count, 2))
    turn, size = float(pyramid.solid.turn), float(pyramid.solid.size)
    c, s = np.cos(turn), np.sin(turn)
    local = (base - np.asarray(pyramid.solid.place, np.float64)) @ np.array([[c, -s], [s, c]]) / size
    outside = ~is_inside(name, local)
    base = np.insert(clear_of_outline(name, local[outside], count, base[outside]), 2, 0.0, axis=1)
    w = RNG.uniform(0.012, height, count)
    reach = 1.0 - w / height
    side = np.stack([reach, reach * RNG.uniform(-1, 1, count), w], axis=-1)
    quarter = RNG.integers(4, size=count)
    c, s = np.cos(quarter * np.pi / 2), np.sin(quarter * np.pi / 2)
    side[:, 0], side[:, 1] = c * side[:, 0] - s * side[:, 1], s * side[:, 0] + c * side[:, 1]
    return floor, wall, base, side


@pytest.mark.parametrize("framing", list(Framing))
def test_points_of_the_faces_are_told_apart(framing):
    for index in range(len(PATTERNS)):
        pyramid = pyramid_scene(Split.TEST, index, framing)
        for own, is_pattern in zip(faces(pyramid), (True, True, False, False), strict=True):
            assert len(own) > 100
            x = to_scene(pyramid, own)
            assert np.abs(np.asarray(values(pyramid, x))).max() < 5e-6
            np.testing.assert_array_equal(on_cue(pyramid, x), is_pattern)


def test_scenes_spread_over_their_ranges_and_orientations():
    pyramids = scenes(Split.TRAIN, 1500)
    for leaf, low, high in (
        (pyramids.solid.height, 1.2, 1.6),
        (pyramids.solid.size, 0.7, 0.85),
        (pyramids.solid.turn, 0.0, 2 * np.pi),
        (pyramids.solid.depth, 0.07, 0.1),
    ):
        share = (np.asarray(leaf) - low) / (high - low)
        assert 0 <= share.min() < 0.01
        assert 0.99 < share.max() <= 1
    rotation = np.asarray(pyramids.solid.rotation, np.float64)
    np.testing.assert_allclose(rotation @ rotation.transpose(0, 2, 1), np.tile(np.eye(3), (1500, 1, 1)), atol=1e-5)
    np.testing.assert_allclose(np.linalg.det(rotation), 1.0, atol=1e-5)
    # The mean of 1500 random directions has components of standard deviation 1 / sqrt(3 * 1500).
    assert np.abs(rotation[:, :, 2].mean(axis=0)).max() < 5 / np.sqrt(4500)


def test_classes_take_turns_and_a_scene_is_the_same_however_it_is_built():
    together = scenes(Split.TEST, 12, Framing.WHOLE)
    assert [int(label) for label in together.solid.pattern] == [index % 5 for index in range(12)]
    x = RNG.uniform(-0.7, 0.7, (200, 3))
    expected = np.asarray(jax.jit(jax.vmap(lambda pyramid: pyramid(x)))(together))
    for index in (0, 4, 11):
        alone = pyramid_scene(Split.TEST, index, Framing.WHOLE)
        for a, b in zip(jax.tree.leaves(alone), jax.tree.leaves(together), strict=True):
            np.testing.assert_allclose(a, b[index], atol=2e-6)
        np.testing.assert_allclose(values(alone, x), expected[index], atol=2e-6)


def test_a_hidden_view_does_not_show_the_pattern():
    candidates = sphere_candidates(20)
    for index, framing in enumerate(Framing):
        pyramid = pyramid_scene(Split.TEST, index, framing)
        drawn = [hidden_view(pyramid, jax.random.key(seed), CAMERA, candidates) for seed in range(5)]
        again = hidden_view(pyramid, jax.random.key(3), CAMERA, candidates)
        np.testing.assert_array_equal(again.position, drawn[3].position)
        away = [np.linalg.norm(np.asarray(candidates.position) - pose.position, axis=1) for pose in drawn]
        assert np.min(away, axis=1).max() < 1e-6
        assert len({*np.argmin(away, axis=1)}) > 2
        for pose in drawn:
            points = scan(SDFSurface(pyramid), CAMERA, pose).to_numpy()[0]
            offset, rotation, scale = map(
                np.asarray, (pyramid.solid.offset, pyramid.solid.rotation, pyramid.solid.scale)
            )
            own = (points - offset) @ rotation / scale
            assert len(own) > 100
            # Only base or sides are visible: all hits above the base lie on a slanted plane.
            above = own[own[:, 2] > 5e-3]
            side = (np.abs(above[:, :2]).max(axis=1) - 1) * float(pyramid.solid.height) + above[:, 2]
            assert np.abs(side).max(initial=0.0) < 2e-2


def test_bad_input_is_refused():
    pyramid = pyramid_scene(Split.TEST, 0)
    with pytest.raises(InputError, match="number is -1"):
        pyramid_scene(Split.TEST, -1)
    # The base faces the only candidate.
    outward = np.asarray(sphere_candidates(1, 1.0).position)[0]
    across = np.cross(outward, np.roll(outward, 1))
    across /= np.linalg.norm(across)
    rotation = np.stack([across, np.cross(-outward, across), -outward], axis=-1)
    facing = eqx.tree_at(
        lambda p: (p.solid.rotation, p.solid.offset), pyramid, (jnp.asarray(rotation), jnp.asarray(0.6 * outward))
    )
    with pytest.raises(InputError, match="shows from all 1 candidates"):
        hidden_view(facing, jax.random.key(0), CAMERA, sphere_candidates(1))
    with pytest.raises(InputError, match="must not be negative"):
        ImprintedPyramid(*jax.tree.leaves(eqx.tree_at(lambda p: p.depth, pyramid.solid, jnp.asarray(-0.1))))
