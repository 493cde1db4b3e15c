"""Several objects on a table: the pixels of each, and a session for each."""

import dataclasses
import functools
import warnings

import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import jaxnbv as nbv
from jaxnbv.planning.sessions import clusters
from jaxnbv.scanning.sdf import Cuboid, Translated, Union

CAMERA = nbv.Camera(height=96, width=128, fov=0.9)
BOX = ((-0.25, -0.2, 0.002), (0.25, 0.2, 0.2))
# Half sizes in metres.
SIZES = {"brick": (0.06, 0.03, 0.03), "cube": (0.035, 0.035, 0.035), "plank": (0.07, 0.035, 0.012)}
PLACES = {"brick": (-0.12, 0.0, 0.03), "cube": (0.12, 0.03, 0.035)}
TABLE = Translated(Cuboid(np.array([0.6, 0.6, 0.05])), np.array([0.0, 0.0, -0.05]))
WORLD = nbv.SDFSurface(
    functools.reduce(
        Union, [TABLE, *(Translated(Cuboid(np.array(SIZES[name])), np.array(at)) for name, at in PLACES.items())]
    ),
    bounding_radius=2.0,
)
BANK = nbv.ShapeBank.of([Cuboid(np.array(size)) for size in SIZES.values()], list(SIZES), is_true_size=True)
FRONT, BACK = ((0.1, -0.45, 0.35), (0.05, 0.5, 0.3))


def at(position):
    return np.asarray(nbv.look_at(position, up=(0.0, 0.0, 1.0)).matrix, np.float64)


@functools.cache
def image(position):
    pose = nbv.Pose.from_matrix(at(position))
    scan = nbv.scan(WORLD, CAMERA, pose)
    depth = (np.asarray(scan.points, np.float64) - np.asarray(pose.position)) @ np.asarray(pose.forward)
    noise = 0.0005 * np.random.default_rng(0).standard_normal(depth.shape)
    return np.where(scan.mask, depth + noise, 0.0).reshape(CAMERA.height, CAMERA.width)


# Small, and of few starts.
PLANNER = nbv.Planner.for_parts(BANK)
MODEL = dataclasses.replace(PLANNER.sampler.model, num_starts=1024)
PLANNER = dataclasses.replace(
    PLANNER,
    sampler=dataclasses.replace(PLANNER.sampler, model=MODEL, grid=nbv.Grid(32), num_samples=2),
    search=nbv.DiscreteSearch(6),
    camera=nbv.Camera(height=12, width=16),
    capacity=500,
    max_views=4,
)


def sessions_of(**changes):
    settings = {"up": "z", "until": nbv.Identified(0.8), "progress": False, **changes}
    return nbv.Sessions(CAMERA, BOX, PLANNER, **settings)


@pytest.fixture(scope="module")
def looked(tmp_path_factory):
    """Views from the front and from behind, which shows other faces of both objects."""
    folder = tmp_path_factory.mktemp("sessions")
    sessions = sessions_of(folder=folder)
    sessions.add(image(FRONT), at(FRONT))
    first = {number: np.asarray(session.cloud.to_numpy()[0]) for number, session in sessions.objects.items()}
    sessions.add(image(BACK), at(BACK))
    return sessions, first, folder


def test_each_object_is_a_session_with_its_own_points_name_and_place(looked):
    """Another side of an object is no new one."""
    sessions, first, _ = looked
    assert sorted(first) == sorted(sessions.objects) == [1, 2]
    sides = {number: "brick" if points[:, 0].mean() < 0 else "cube" for number, points in first.items()}
    assert sorted(sides.values()) == ["brick", "cube"]
    for number, session in sessions.objects.items():
        size, place = np.array(SIZES[sides[number]]), np.array(PLACES[sides[number]])
        assert first[number][:, 0].mean() == pytest.approx(place[0], abs=0.03)
        assert first[number][:, 2].min() > 0.0, "no point of the table"
        assert len(session.views) == 2
        assert next(iter(session.identity)) == session.object_pose.name == sides[number]
        np.testing.assert_allclose(session.object_pose.matrix[:3, 3], place, atol=0.004)
        # The box is a cube that holds it.
        assert np.all(session.box.low < place - size)
        assert np.all(session.box.high > place + size)
        sides_of_box = session.box.high - session.box.low
        np.testing.assert_allclose(sides_of_box, sides_of_box[0])


def test_the_next_view_is_worth_most_to_all(looked):
    sessions, _, _ = looked
    each = list(sessions.objects.values())
    # The information needs no samples, so that keys do not matter.
    proposals = [session.planner.propose(session.observations, jax.random.key(0)) for session in each]
    counted = [p for p, session in zip(proposals, each, strict=True) if session.done() is None] or proposals
    best = int(np.argmax(sum(np.asarray(proposal.values, np.float64) for proposal in counted)))
    place = each[0].frame.to_world(proposals[0].candidates[best])
    np.testing.assert_allclose(sessions.next(), place.matrix, atol=1e-4)
    np.testing.assert_array_equal(sessions.next(), sessions.next())


def test_it_is_done_once_all_are(looked):
    sessions, _, _ = looked
    reasons = [session.done() for session in sessions.objects.values()]
    assert (sessions.done() is None) == (None in reasons)


def test_they_go_on_from_their_folder(looked):
    sessions, _, folder = looked
    again = sessions_of(folder=folder)
    for number, session in sessions.objects.items():
        assert again.objects[number].identity == session.identity


@functools.cache
def true_sides():
    """Pixels of the brick and of the cube in the first image."""
    points = np.asarray(nbv.scan(WORLD, CAMERA, nbv.Pose.from_matrix(at(FRONT))).points).reshape(96, 128, 3)
    above = points[..., 2] > 0.004
    return above & (points[..., 0] < 0), above & (points[..., 0] > 0)


def test_labels_say_whose_each_pixel_is(looked):
    """The numbers are the caller's. Zero means no object."""
    _, first, _ = looked
    left, right = true_sides()
    labelled = sessions_of()
    labelled.add(image(FRONT), at(FRONT), labels=7 * left + 3 * right)
    assert sorted(labelled.objects) == [3, 7]
    by_clusters = {points[:, 0].mean() < 0: points for points in first.values()}
    for number, is_left in ((7, True), (3, False)):
        own = np.asarray(labelled.objects[number].cloud.to_numpy()[0])
        assert len(own) == pytest.approx(len(by_clusters[is_left]), rel=0.1)


def test_a_second_object_compiles_nothing(compilations):
    """The second object has another box."""
    sides, count = [], []
    for mask in true_sides():
        sessions = sessions_of(obstacles=nbv.Obstacles())
        sessions.add(image(FRONT), at(FRONT), labels=mask.astype(int))
        sides.append(sessions.objects[1].box.high - sessions.objects[1].box.low)
        count.append(len(compilations))
    assert abs(sides[0][0] - sides[1][0]) > 0.01
    assert count[1] == count[0] > 0


def test_bad_input_is_named():
    with pytest.raises(nbv.InputError, match="knows no parts"):
        nbv.Sessions(CAMERA, BOX, nbv.Planner(nbv.Coverage()), up="z")
    with pytest.raises(nbv.InputError, match="the gap is -1"):
        sessions_of(gap=-1.0)
    with pytest.raises(nbv.InputError, match="no image yet"):
        sessions_of().next()
    with pytest.raises(nbv.InputError, match="the labels are"):
        sessions_of().add(image(FRONT), at(FRONT), labels=np.zeros((4, 4), int))
    with pytest.raises(nbv.InputError, match="shows no object in the box"):
        sessions_of().add(image(FRONT), at(FRONT), labels=np.zeros((96, 128), int))


def test_without_a_table_it_says_so():
    with warnings.catch_warnings(record=True) as warning_list:
        warnings.simplefilter("always")
        sessions_of().add(np.where(true_sides()[0], image(FRONT), 0.0), at(FRONT))
    assert sum("no table under the objects" in str(warning.message) for warning in warning_list) == 1


@given(st.integers(0, 2**32 - 1), st.integers(1, 5))
def test_clusters_against_single_linkage(seed, count):
    """Points on lines two gaps apart, shuffled. Steps along a line are half a gap."""
    draw = np.random.default_rng(seed)
    sizes = draw.integers(2, 30, count)
    lines = [
        np.column_stack([0.5 * np.arange(size), np.full(size, 3.0 * line), np.zeros(size)])
        for line, size in enumerate(sizes)
    ]
    owner = np.repeat(np.arange(count), sizes)
    order = draw.permutation(len(owner))
    labels = clusters(np.concatenate(lines)[order], 1.0)
    # One number for each line, and no number twice.
    pairs = {(int(a), int(b)) for a, b in zip(owner[order], labels, strict=True)}
    assert len(pairs) == count == len({b for _, b in pairs})
    assert clusters(np.zeros((0, 3)), 1.0).shape == (0,)
