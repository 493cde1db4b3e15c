"""Heat diffusion against closed forms on the sphere and the plate, and heat balances."""

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import eval_legendre

import jaxnbv as nbv
from jaxnbv.tasks.diffusion import cloud_laplacian, cloud_temperature, diffuse, mesh_laplacian, mesh_temperature, refine

RNG = np.random.default_rng(0)
NOWHERE = np.array([9.0, 9.0, 9.0])


def sphere_points(count, radius=1.0):
    return radius * np.asarray(nbv.geometry.fibonacci_sphere(count, 1.0), np.float64)


def plate(across, along, width=1.0, height=0.5):
    """A triangulated rectangle whose inner vertices are moved at random."""
    index = np.arange(across * along).reshape(across, along)
    x, y = np.meshgrid(np.linspace(0, width, across), np.linspace(0, height, along), indexing="ij")
    vertices = np.stack([x, y, np.zeros_like(x)], axis=-1)
    vertices[1:-1, 1:-1, :2] += 0.3 * width / across * RNG.uniform(-1, 1, (across - 2, along - 2, 2))
    a, b, c, d = (i.ravel() for i in (index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]))
    return vertices.reshape(-1, 3), np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])


def test_a_heated_sphere_against_its_series():
    """u_T = sum_l f_l sum_k h (1 + h l(l+1))^-k P_l, f_l = power (P_{l-1} - P_{l+1})(cos a) / 2 on a cap of angle a."""
    ball = trimesh.creation.icosphere(5)
    top, radius, steps, duration = np.array([0.0, 0.0, 1.0]), 0.4, 5, 2.0
    heat = nbv.tasks.HeatProblem(top, radius, power=3.0, duration=duration, steps=steps, initial=1.0)
    edge, degrees = 1 - radius**2 / 2, np.arange(1, 200)
    cap = 1.5 * (eval_legendre(degrees - 1, edge) - eval_legendre(degrees + 1, edge))
    powers = (1 + duration / steps * degrees * (degrees + 1)) ** -np.arange(1.0, steps + 1)[:, None]
    weights = cap * duration / steps * powers.sum(axis=0)
    mesh = mesh_temperature(np.asarray(ball.vertices), np.asarray(ball.faces), heat)
    cloud = cloud_temperature(sphere_points(4000), heat)
    for points, (values, reached) in ((np.asarray(ball.vertices), mesh), (sphere_points(4000), cloud)):
        exact = 1.0 + duration * 1.5 * (1 - edge) + eval_legendre(degrees, points[:, 2:]) @ weights
        assert reached.all()
        # The cap's area is that of the vertices in it.
        np.testing.assert_allclose(values - 1.0, exact - 1.0, rtol=0.03)
        assert exact[values.argmin()] < exact.min() + 1e-3 < exact.max() - 0.1


def test_cosine_modes_of_an_insulated_plate_decay_as_they_should():
    vertices, faces = plate(41, 21)
    duration, steps = 0.05, 10
    for tolerance, laplacian in ((0.05, cloud_laplacian(vertices)), (0.01, mesh_laplacian(vertices, faces))):
        for i, j in ((1, 0), (0, 1), (2, 1)):
            mode = np.cos(np.pi * i * vertices[:, 0]) * np.cos(np.pi * j * vertices[:, 1] / 0.5)
            rate = np.pi**2 * (i**2 + (j / 0.5) ** 2)
            result = diffuse(laplacian, mode, np.zeros(len(mode)), duration, steps)
            decay = (1 + duration / steps * rate) ** -steps
            np.testing.assert_allclose(result, decay * mode, atol=tolerance)


def test_heat_is_conserved_and_grows_by_what_the_source_gives():
    points = sphere_points(400) * (1.0 + 0.2 * RNG.uniform(size=(400, 1)))
    laplacian = cloud_laplacian(points)
    start, heating = RNG.uniform(size=400), np.where(points[:, 0] > 0.9, 10.0, 0.0)
    for steps in (1, 7):
        without_source = diffuse(laplacian, start, 0.0 * heating, 3.0, steps)
        fed = diffuse(laplacian, start, heating, 3.0, steps)
        before = laplacian.mass @ start
        assert laplacian.mass @ without_source == pytest.approx(before, rel=1e-12)
        assert laplacian.mass @ fed == pytest.approx(before + 3.0 * laplacian.mass @ heating, rel=1e-12)
        assert start.min() < without_source.min() < without_source.max() < start.max()


def test_only_the_piece_with_the_source_gets_warm():
    ball = sphere_points(200, 0.5)
    points = np.concatenate([ball, ball + np.array([5.0, 0.0, 0.0])])
    heat = nbv.tasks.HeatProblem(ball[7], initial=3.0)
    values, reached = cloud_temperature(points, heat)
    np.testing.assert_array_equal(reached, np.arange(400) < 200)
    np.testing.assert_array_equal(values[200:], 3.0)
    alone = cloud_temperature(ball, heat).values
    np.testing.assert_allclose(values[:200], alone, rtol=1e-10)
    assert alone.min() > 3.1
    # Across the ball from the source, and beside it.
    assert np.linalg.norm(ball[alone.argmin()] + ball[7]) < 0.15
    assert np.linalg.norm(ball[alone.argmax()] - ball[7]) < 0.15


def test_a_source_without_points_nearby():
    for heat in (
        nbv.tasks.HeatProblem(NOWHERE, initial=-2.0),
        nbv.tasks.HeatProblem(np.zeros(3), power=0.0, initial=-2.0),
    ):
        values, reached = cloud_temperature(np.concatenate([np.zeros((1, 3)), sphere_points(50)]), heat)
        np.testing.assert_array_equal(values, -2.0)
        assert not reached.any()


def test_the_source_warms_the_share_of_a_disc_within_its_radius():
    distances = np.array([0.0, 0.15, 0.2, 0.225, 0.25, 0.3])
    heat = nbv.tasks.HeatProblem(np.array([0.1, -0.4, 2.0]), radius=0.2, power=4.0)
    points = heat.source + distances[:, None] * np.array([0.6, 0.0, 0.8])
    small, large = np.pi * 0.05**2, np.pi * 0.2**2
    shares = heat.heating(points, np.full(6, small)) / 4.0
    np.testing.assert_allclose(shares, [1.0, 1.0, 0.5, 0.25, 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(heat.heating(points, np.full(6, large))[[0, 5]], [4.0, 1.0], atol=1e-12)
    # Points with almost no area are either within or not.
    np.testing.assert_array_equal(heat.heating(points[[1, 3]], np.full(2, 1e-30)), [4.0, 0.0])


def test_points_without_triangles_keep_what_they_get():
    """Lines, pairs and single points conduct nothing: u0 + T power at the source, and u0 elsewhere."""
    line = np.linspace(0.0, 1.0, 40)[:, None] * np.array([1.0, 2.0, -1.0])
    heat = nbv.tasks.HeatProblem(line[0], radius=1e-3, power=2.0, duration=3.0, initial=1.0)
    for points in (line, line[:1], line[:2], np.tile(line[:1], (35, 1)), np.concatenate([line, line + 7.0])):
        distinct, place = np.unique(points, axis=0, return_inverse=True)
        gained = 3.0 * heat.heating(distinct, cloud_laplacian(distinct).mass)[place.reshape(-1)]
        values, reached = cloud_temperature(points, heat)
        np.testing.assert_allclose(values, 1.0 + gained, rtol=1e-9)
        np.testing.assert_array_equal(reached, gained > 0)
        assert reached[(points == line[0]).all(axis=1)].all()
    # A line beside a body, which the library would fix at zero degrees.
    both = np.concatenate([line, sphere_points(60) + 9.0])
    values, reached = cloud_temperature(both, heat)
    assert values[0] > 3.0
    np.testing.assert_allclose(values[reached.sum() :], 1.0, rtol=1e-14)
    assert 1 <= reached.sum() < 20
    assert cloud_temperature(np.zeros((0, 3)), heat).values.shape == (0,)


@settings(max_examples=40)
@given(st.integers(0, 2**32 - 1), st.integers(1, 45), st.integers(0, 40), st.sampled_from([1.0, 1e-3, 0.0]))
def test_any_cloud_has_a_temperature(seed, count, copies, flatness):
    """Few points, flat clouds, lines and copies give temperatures within bounds, in any order, and equal for equal
    points."""
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(count, 3)) * [1.0, flatness, flatness]
    order = np.concatenate([np.arange(count), rng.integers(0, count, copies)])
    heat = nbv.tasks.HeatProblem(points[0], radius=0.3, initial=1.0)
    once = cloud_temperature(points, heat)
    again = cloud_temperature(points[order], heat)
    np.testing.assert_array_equal(again.values, once.values[order])
    np.testing.assert_array_equal(again.reached, once.reached[order])
    assert once.reached[0]
    assert heat.highest == 51.0
    assert once.values.min() > 1.0 - 1e-9
    assert once.values.max() < heat.highest + 1e-9


def test_heat_crosses_the_seams_of_a_soup():
    ball = trimesh.creation.icosphere(2)
    heat = nbv.tasks.HeatProblem(np.asarray(ball.vertices[0]), radius=0.4)
    whole = mesh_temperature(np.asarray(ball.vertices), np.asarray(ball.faces), heat)
    soup = np.asarray(ball.vertices)[ball.faces].reshape(-1, 3)
    # The soup includes a triangle that is a point, and an unused vertex.
    soup = np.concatenate([soup, np.tile(soup[:1], (3, 1)), NOWHERE[None]])
    corners = np.arange(len(soup) - 1).reshape(-1, 3)
    apart = mesh_temperature(soup, corners, heat)
    np.testing.assert_allclose(apart.values[: ball.faces.size], whole.values[ball.faces.ravel()], rtol=1e-12)
    assert whole.reached.all()
    assert apart.reached[:-1].all()
    assert apart.values[-1] == 0.0
    assert not apart.reached[-1]


@pytest.mark.parametrize("longest", [0.9, 0.31])
def test_refinement_halves_edges_and_tears_nothing(longest):
    box = trimesh.creation.box((2.5, 0.1, 0.7))
    vertices, faces = refine(np.asarray(box.vertices), np.asarray(box.faces), longest)
    fine = trimesh.Trimesh(vertices, faces, process=False)
    assert longest / 2 - 0.1 < fine.edges_unique_length.max() <= longest
    assert fine.is_watertight
    assert fine.is_winding_consistent
    assert fine.area == pytest.approx(box.area, rel=1e-12)
    assert fine.volume == pytest.approx(box.volume, rel=1e-12)
    np.testing.assert_array_equal(vertices[:8], box.vertices)
    assert len(np.unique(vertices, axis=0)) == len(vertices)


def test_bad_input_is_named():
    heat, bad = nbv.tasks.HeatProblem(np.zeros(3)), sphere_points(40)
    bad[5, 1] = np.nan
    for solve in (lambda: cloud_temperature(bad, heat), lambda: mesh_temperature(bad, np.array([[0, 1, 2]]), heat)):
        with pytest.raises(nbv.InputError, match="1 points are not finite"):
            solve()
    with pytest.raises(nbv.InputError, match="longest edge is 0"):
        refine(bad, np.array([[0, 1, 2]]), 0.0)
    for message, wrong in {
        "radius is 0": {"radius": 0.0},
        "duration is -1": {"duration": -1.0},
        "power is nan": {"power": np.nan},
        "initial is inf": {"initial": np.inf},
        "time steps is 0": {"steps": 0},
        "heat source is": {"source": np.array([0.0, np.nan, 0.0])},
    }.items():
        with pytest.raises(nbv.InputError, match=message):
            nbv.tasks.HeatProblem(**{"source": np.zeros(3), **wrong})


def test_three_points_are_a_triangle():
    """By the cotangent formula. A line of three points conducts nothing."""
    points = np.array([[0.0, 0.0, 0.3], [2.0, 0.0, 0.3], [0.5, 1.0, 0.3]])
    laplacian = cloud_laplacian(points)
    a, b, c = points
    expected = np.zeros((3, 3))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        u, v = points[i] - points[k], points[j] - points[k]
        expected[i, j] = expected[j, i] = 0.5 * (u @ v) / np.linalg.norm(np.cross(u, v))
    expected -= np.diag(expected.sum(axis=1))
    np.testing.assert_allclose(laplacian.weak.toarray(), -expected, atol=1e-9)
    np.testing.assert_allclose(laplacian.mass, np.linalg.norm(np.cross(b - a, c - a)) / 6.0)
    line = cloud_laplacian(np.array([[0.0, 0.0, 0.0], [1.0, 2.0, 3.0], [2.0, 4.0, 6.0]]))
    assert line.weak.nnz == 0
