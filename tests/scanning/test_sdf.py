"""Signed distance functions against sampled surfaces, and sphere tracing against closed forms in float64 NumPy."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import cKDTree

from jaxnbv.camera import Camera, fibonacci_sphere, look_at
from jaxnbv.scanning.scanner import scan
from jaxnbv.scanning.sdf import Box, Capsule, Cone, Cylinder, Intersection, SmoothUnion, Sphere, Torus
from jaxnbv.scanning.sphere_tracing import SDFSurface

RNG = np.random.default_rng(0)


def revolve(profile):
    """A dense sampling of the surface that the polyline `profile` (n, 2), of (radius, y), sweeps about the y axis."""
    ends = zip(profile[:-1], profile[1:], strict=True)
    line = np.concatenate([np.linspace(a, b, math.ceil(np.linalg.norm(b - a) / 0.006) + 1) for a, b in ends])
    angle = np.linspace(0, 2 * np.pi, 600, endpoint=False)
    r, y = np.repeat(line, 600, axis=0).T
    angle = np.tile(angle, len(line))
    return np.stack([r * np.cos(angle), y, r * np.sin(angle)], axis=-1)


def arc(cx, cy, r, start, stop):
    t = np.linspace(start, stop, 400)
    return np.stack([cx + r * np.cos(t), cy + r * np.sin(t)], axis=-1)


def box_surface(half):
    u = np.linspace(-1, 1, 200)
    a, b = (c.ravel() for c in np.meshgrid(u, u))
    faces = [np.insert(np.stack([a, b], -1), axis, side, axis=1) for axis in range(3) for side in (-1, 1)]
    return np.concatenate(faces) * half


def rounded_box_surface(half, rounding):
    """The inner box's surface pushed out along every direction of the normal cone."""
    half = np.asarray(half)
    u = np.asarray(fibonacci_sphere(120_000))
    corners = np.sign(u) * (half - rounding) + rounding * u
    flat = []
    for axis in range(3):
        for side in (-1, 1):
            a, b = (np.linspace(-1, 1, 200) * (half - rounding)[k] for k in range(3) if k != axis)
            grid = np.stack([c.ravel() for c in np.meshgrid(a, b)], -1)
            flat.append(np.insert(grid, axis, side * half[axis], axis=1))
        theta, along = np.meshgrid(np.linspace(0, 2 * np.pi, 400), np.linspace(-1, 1, 150))
        ring = np.stack([np.cos(theta).ravel(), np.sin(theta).ravel()], -1)
        inner = np.delete(half - rounding, axis)
        edge = np.sign(ring) * inner + rounding * ring
        flat.append(np.insert(edge, axis, along.ravel() * (half - rounding)[axis], axis=1))
    return np.concatenate([corners, *flat])


def turned(points, axis, angle):
    axis = np.asarray(axis) / np.linalg.norm(axis)
    cross = np.cross(axis, points)
    along = (points @ axis)[:, None] * axis
    return along + np.cos(angle) * (points - along) + np.sin(angle) * cross


CAPSULE_PROFILE = np.concatenate([arc(0, -0.5, 0.3, -np.pi / 2, 0), arc(0, 0.5, 0.3, 0, np.pi / 2)])
EXACT = {
    "sphere": (Sphere(0.8), 0.8 * np.asarray(fibonacci_sphere(200_000))),
    "box": (Box([0.7, 0.5, 0.9]), box_surface([0.7, 0.5, 0.9])),
    "rounded box": (Box([0.7, 0.5, 0.9], 0.2), rounded_box_surface([0.7, 0.5, 0.9], 0.2)),
    "cylinder": (Cylinder(0.6, 0.8), revolve(np.array([[0, -0.8], [0.6, -0.8], [0.6, 0.8], [0, 0.8]]))),
    "cone": (Cone(0.9, 0.3, 0.6), revolve(np.array([[0, -0.6], [0.9, -0.6], [0.3, 0.6], [0, 0.6]]))),
    "flat cone": (Cone(0.1, 1.0, 0.1), revolve(np.array([[0, -0.1], [0.1, -0.1], [1.0, 0.1], [0, 0.1]]))),
    "pointed cone": (Cone(0.8, 0.0, 0.5), revolve(np.array([[0, -0.5], [0.8, -0.5], [0, 0.5]]))),
    "torus": (Torus(0.7, 0.25), revolve(arc(0.7, 0, 0.25, 0, 2 * np.pi))),
    "capsule": (Capsule([0, -0.5, 0], [0, 0.5, 0], 0.3), revolve(CAPSULE_PROFILE)),
    "moved": (
        Capsule([0, -0.5, 0], [0, 0.5, 0], 0.3).rotate([1, 2, 3], 0.7).scale(0.5).translate([0.2, -0.1, 0.3]),
        0.5 * turned(revolve(CAPSULE_PROFILE), [1, 2, 3], 0.7) + [0.2, -0.1, 0.3],
    ),
}
MUG = (Cylinder(0.8, 0.8) - Cylinder(0.7, 0.8).translate([0, 0.1, 0])) | Torus(0.4, 0.1).rotate(
    [1, 0, 0], np.pi / 2
).translate([0.8, 0, 0])
BOUNDS = {
    "union": Sphere(0.6).translate([0.3, 0, 0]) | Box([0.5, 0.4, 0.3]),
    "smooth union": SmoothUnion(Sphere(0.6).translate([0.4, 0, 0]), Cylinder(0.3, 0.9), 0.3),
    "intersection": Sphere(0.8) & Box([0.5, 0.6, 0.7]),
    "difference": Box([0.8, 0.8, 0.8]) - Sphere(0.9),
    "mug": MUG.scale(0.9),
}


@pytest.mark.parametrize("name", EXACT)
def test_exact_distance_equals_that_to_a_dense_sampling(name):
    sdf, surface = EXACT[name]
    x = RNG.uniform(-1.6, 1.6, (3000, 3))
    nearest, _ = cKDTree(surface).query(x)
    value = np.asarray(sdf(x))
    far = nearest > 0.05
    # A sampling of spacing s overestimates a distance d by at most s^2 / (2 d); s < 0.012 here.
    np.testing.assert_allclose(np.abs(value[far]), nearest[far], atol=2e-3)
    assert (np.abs(value) <= nearest + 2e-5).all()


@pytest.mark.parametrize("name", EXACT)
def test_exact_distance_is_negative_inside_only(name):
    sdf, surface = EXACT[name]
    assert np.abs(np.asarray(sdf(surface))).max() < 2e-3
    outside = surface.mean(axis=0) + 4.0 * np.asarray(fibonacci_sphere(200))
    assert (np.asarray(sdf(outside)) > 0).all()
    gradient = np.asarray(jax.vmap(jax.grad(sdf))(jnp.asarray(surface[::50])))
    smooth = np.abs(np.linalg.norm(gradient, axis=1) - 1) < 1e-3
    inward = surface[::50][smooth] - 0.02 * gradient[smooth]
    # At a sharp edge the slope is that of one face, and the step may stay on the other.
    assert (np.asarray(sdf(inward)) < 1e-6).all()
    assert (np.asarray(sdf(inward)) < -0.01).mean() > 0.9


@pytest.mark.parametrize("name", EXACT)
def test_exact_distance_has_slope_one_almost_everywhere(name):
    sdf, _ = EXACT[name]
    x = jnp.asarray(RNG.uniform(-1.6, 1.6, (5000, 3)), dtype=jnp.result_type(float))
    slope = np.linalg.norm(np.asarray(jax.vmap(jax.grad(sdf))(x)), axis=1)
    assert (np.abs(slope - 1) < 1e-4).mean() > 0.999


@pytest.mark.parametrize("name", BOUNDS)
def test_bounds_never_overestimate(name):
    """Slopes of at most one between random points, near and far, and a change of sign at the surface, imply it."""
    sdf = BOUNDS[name]
    x = RNG.uniform(-1.6, 1.6, (20_000, 3))
    y = x + RNG.normal(size=x.shape) * 10.0 ** RNG.uniform(-2, 0.3, (len(x), 1))
    change = np.abs(np.asarray(sdf(x)) - np.asarray(sdf(y)))
    assert (change <= np.linalg.norm(x - y, axis=1) + 1e-5).all()


def test_set_operations_agree_with_membership():
    a, b = Sphere(0.7).translate([0.3, 0, 0]), Box([0.6, 0.5, 0.4])
    x = RNG.uniform(-1.2, 1.2, (20_000, 3))
    in_a = np.linalg.norm(x - [0.3, 0, 0], axis=1) < 0.7
    in_b = (np.abs(x) < [0.6, 0.5, 0.4]).all(axis=1)
    for sdf, expected in ((a | b, in_a | in_b), (a & b, in_a & in_b), (a - b, in_a & ~in_b)):
        value = np.asarray(sdf(x))
        decided = np.abs(value) > 1e-5
        assert ((value < 0) == expected)[decided].all()
    union = np.asarray((a | b)(x))
    smooth = np.asarray(SmoothUnion(a, b, 0.2)(x))
    assert (smooth <= union + 1e-6).all()
    assert (smooth >= union - 0.05 - 1e-6).all()


def test_rigid_transform_moves_points_as_the_pose_does():
    pose = look_at([0.5, 0.4, -0.3], target=[0.1, 0.9, 0.2])
    sdf = Box([0.3, 0.5, 0.2])
    x = jnp.asarray(RNG.uniform(-1, 1, (500, 3)), dtype=jnp.result_type(float))
    np.testing.assert_allclose(sdf.transform(pose)(pose.to_scene(x)), sdf(x), atol=1e-6)


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: Sphere(-1.0), "must not be negative"),
        (lambda: Sphere(np.nan), "finite"),
        (lambda: Box([0.1, 0.2, 0.3], 0.15), "round it by less"),
        (lambda: Sphere(1.0).rotate([0, 0, 0], 1.0), "not zero"),
        (lambda: Sphere(1.0).scale(-2.0), "must not be negative"),
        (lambda: SDFSurface(Sphere(1.0), 0.0), "must be positive"),
    ],
)
def test_bad_parameters_are_refused(build, message):
    with pytest.raises(ValueError, match=message):
        build()


def sphere_hit(o, d, radius):
    b = np.sum(o * d, axis=1)
    squared = b**2 - np.sum(o**2, axis=1) + radius**2
    root = np.sqrt(np.maximum(squared, 0))
    t = np.where(-b - root > 0, -b - root, -b + root)
    return np.where((squared > 0) & (t > 0), t, np.inf)


def box_hit(o, d, half):
    a, b = (-half - o) / d, (half - o) / d
    enter, leave = np.minimum(a, b).max(axis=1), np.maximum(a, b).min(axis=1)
    t = np.where(enter > 0, enter, leave)
    return np.where((enter < leave) & (t > 0), t, np.inf)


def cylinder_hit(o, d, radius, half_height):
    a, b = d[:, 0] ** 2 + d[:, 2] ** 2, o[:, 0] * d[:, 0] + o[:, 2] * d[:, 2]
    squared = b**2 - a * (o[:, 0] ** 2 + o[:, 2] ** 2 - radius**2)
    root = np.sqrt(np.maximum(squared, 0))
    low, high = (-half_height - o[:, 1]) / d[:, 1], (half_height - o[:, 1]) / d[:, 1]
    enter = np.maximum(np.minimum(low, high), (-b - root) / a)
    leave = np.minimum(np.maximum(low, high), (-b + root) / a)
    t = np.where(enter > 0, enter, leave)
    return np.where((squared > 0) & (enter < leave) & (t > 0), t, np.inf)


def torus_hit(o, d, major, minor):
    """Least positive root of the quartic (|x|^2 + R^2 - r^2)^2 = 4 R^2 (x^2 + z^2)."""
    t = np.full(len(o), np.inf)
    for i, (p, q) in enumerate(zip(o, d, strict=True)):
        square = np.array([1.0, 2 * p @ q, p @ p + major**2 - minor**2])
        ring = np.array([q[0] ** 2 + q[2] ** 2, 2 * (p[0] * q[0] + p[2] * q[2]), p[0] ** 2 + p[2] ** 2])
        quartic = np.polymul(square, square)
        quartic[2:] -= 4 * major**2 * ring
        roots = np.roots(quartic)
        real = roots.real[(np.abs(roots.imag) < 1e-7) & (roots.real > 0)]
        t[i] = real.min(initial=np.inf)
    return t


SOLIDS = {
    "sphere": (Sphere(0.9), lambda o, d: sphere_hit(o, d, 0.9)),
    "box": (Box([0.7, 0.5, 0.9]), lambda o, d: box_hit(o, d, np.array([0.7, 0.5, 0.9]))),
    "cylinder": (Cylinder(0.6, 0.8), lambda o, d: cylinder_hit(o, d, 0.6, 0.8)),
    "torus": (Torus(0.7, 0.3), lambda o, d: torus_hit(o, d, 0.7, 0.3)),
}


def some_rays(count, radius=2.5):
    origins = RNG.normal(size=(count, 3))
    origins *= radius / np.linalg.norm(origins, axis=1, keepdims=True)
    directions = RNG.uniform(-1, 1, (count, 3)) - origins
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return origins.astype(np.float32), directions.astype(np.float32)


@pytest.mark.parametrize("inside", [False, True])
@pytest.mark.parametrize("name", SOLIDS)
def test_hits_equal_closed_forms(name, inside):
    sdf, expected = SOLIDS[name]
    o, d = some_rays(2000)
    if inside:
        o = np.zeros_like(o) + np.float32([0.65 if name == "torus" else 0.1, 0.05, 0.02])
    hits = SDFSurface(sdf).trace(o, d)
    t = expected(o.astype(float), d.astype(float))
    mask = np.asarray(hits.mask)
    # Only rays that skim the silhouette may differ: 0.2 % of them.
    assert (mask != np.isfinite(t)).mean() <= 0.002
    both = mask & np.isfinite(t)
    assert both.sum() > 500
    error = np.linalg.norm(np.asarray(hits.points) - (o + t[:, None] * d), axis=1)[both]
    facing = -np.sum(np.asarray(hits.normals) * d, axis=1)[both]
    # Rounding of the distance, 4e-7, over the sine of the angle between ray and surface.
    error = (error * facing)[facing > 0.02]
    assert np.quantile(error, 0.995) < 2e-6
    assert error.max() < 1e-4  # The last chord may end on the wrong side of a sharp edge.
    assert (facing >= 0).all()
    np.testing.assert_allclose(np.linalg.norm(np.asarray(hits.normals)[mask], axis=1), 1.0, atol=1e-5)
    assert not np.asarray(hits.points)[~mask].any()
    assert not np.asarray(hits.normals)[~mask].any()


def test_normals_of_the_sphere_are_radial_and_turned_to_the_sensor():
    o, d = some_rays(1000)
    outer = SDFSurface(Sphere(0.9)).trace(o, d)
    mask = np.asarray(outer.mask)
    np.testing.assert_allclose(outer.normals[mask], outer.points[mask] / 0.9, atol=1e-5)
    inner = SDFSurface(Sphere(0.9)).trace(np.zeros_like(o), d)
    assert bool(inner.mask.all())
    np.testing.assert_allclose(inner.normals, -inner.points / 0.9, atol=1e-5)


def test_image_that_misses_and_image_that_is_filled():
    miss = scan(SDFSurface(Sphere(0.5)), Camera(), look_at([0.0, 0.0, 2.5], target=[0.0, 0.0, 5.0]))
    assert not bool(miss.mask.any())
    assert not np.asarray(miss.points).any()
    full = scan(SDFSurface(Sphere(1.25)), Camera(), look_at([0.0, 0.0, 2.5]))
    assert bool(full.mask.all())
    np.testing.assert_allclose(np.linalg.norm(full.points, axis=-1), 1.25, atol=2e-6)


def test_grazing_ray_is_defined_and_its_derivative_bounded():
    offset = np.array([0.9 - 1e-5, 0.9 - 1e-3, 0.9 + 1e-3, 0.9])
    o = jnp.asarray(np.stack([offset, 0 * offset, 0 * offset + 2.5], -1), dtype=jnp.result_type(float))
    d = jnp.broadcast_to(jnp.asarray([0.0, 0.0, -1.0]), o.shape)
    trace = lambda o, d: SDFSurface(Sphere(0.9)).trace(o, d)
    hits = trace(o, d)
    assert np.asarray(hits.mask)[:3].tolist() == [True, True, False]
    jacobian = np.asarray(jax.jacrev(lambda o: trace(o, d).points)(o))
    assert np.isfinite(jacobian).all()
    # |dx| <= 1 + 1 / least sine.
    assert np.abs(jacobian).max() <= 1 + 1 / 0.05
    assert not jacobian[2].any()


@pytest.mark.parametrize("name", [*SOLIDS, "mug"])
def test_derivatives_of_hits_equal_central_differences(name):
    with jax.enable_x64(True):
        sdf = MUG if name == "mug" else SOLIDS[name][0]
        sdf = jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf), dtype=jnp.float64), sdf)
        o, d = (jnp.asarray(a, dtype=jnp.float64) for a in some_rays(150))

        @jax.jit
        def trace(sdf, o, d):
            hits = SDFSurface(sdf).trace(o, d)
            return hits.points, hits.normals, hits.mask

        do, dd = jnp.asarray(RNG.normal(size=(2, *o.shape)))
        ds = jax.tree.map(lambda leaf: jnp.asarray(RNG.normal(size=leaf.shape)), sdf)
        if name == "mug":  # A random matrix would not keep its rotations.
            ds = jax.tree.map(jnp.zeros_like, ds)
        move = lambda h: jax.tree.map(lambda a, b: a + h * b, (sdf, o, d), (ds, do, dd))
        points, normals, mask = trace(sdf, o, d)
        fixed = lambda sdf, o, d: trace(sdf, o, d)[:2]
        _, (dx, dn) = jax.jvp(fixed, (sdf, o, d), (ds, do, dd))
        h = 1e-5
        ahead, behind = trace(*move(h)), trace(*move(-h))
        same = np.asarray(mask & ahead[2] & behind[2])
        facing = -np.sum(np.asarray(normals) * np.asarray(d), axis=1)
        # Where a ray changes the face it meets there is no derivative: the differences jump.
        smooth = np.linalg.norm(np.asarray(ahead[1] - behind[1]), axis=1) < 1e-2
        use = same & smooth & (facing > 0.15)
        assert use.sum() > 40
        np.testing.assert_allclose(dx[use], (ahead[0] - behind[0])[use] / (2 * h), rtol=1e-4, atol=1e-4)
        np.testing.assert_allclose(dn[use], (ahead[1] - behind[1])[use] / (2 * h), rtol=1e-3, atol=1e-3)
        assert not np.asarray(dx)[~np.asarray(mask)].any()
        assert bool(jnp.isfinite(dx).all() & jnp.isfinite(dn).all())


def test_reverse_mode_has_no_nan_where_rays_miss():
    o, d = some_rays(300)
    surface = SDFSurface(MUG)
    total = lambda surface, o: jnp.sum(surface.trace(o, d).points ** 2) + jnp.sum(surface.trace(o, d).normals[:, 0])
    gradient, rays = jax.grad(total, argnums=(0, 1))(surface, jnp.asarray(o))
    assert all(bool(jnp.isfinite(leaf).all()) for leaf in jax.tree.leaves((gradient, rays)))
    missed = ~np.asarray(surface.trace(o, d).mask)
    assert missed.any()
    assert not np.asarray(rays)[missed].any()


def test_vmapped_scenes_equal_single_scenes():
    sizes = jnp.asarray(RNG.uniform(0.3, 0.9, (5, 2)), dtype=jnp.result_type(float))
    build = lambda size: (
        Box(jnp.stack([size[0], 0.4 * jnp.ones(()), size[1]]), 0.05)
        | Sphere(size[1]).translate(jnp.stack([size[0], size[0], 0.0 * size[0]]))
    )
    camera, poses = Camera(height=20, width=20, fov=0.7), look_at(fibonacci_sphere(5, 2.5))
    together = jax.jit(jax.vmap(lambda size, pose: scan(SDFSurface(build(size)), camera, pose)))(sizes, poses)
    batch = jax.vmap(lambda size: SDFSurface(build(size)))(sizes)
    again = jax.vmap(lambda surface, pose: scan(surface, camera, pose))(batch, poses)
    for i in range(5):
        alone = scan(SDFSurface(build(sizes[i])), camera, poses[i])
        for cloud in (together[i], again[i]):
            assert bool((cloud.mask == alone.mask).all())
            np.testing.assert_allclose(cloud.points, alone.points, atol=1e-5)
            np.testing.assert_allclose(cloud.normals, alone.normals, atol=1e-4)


def test_no_recompilation_for_other_solids_of_the_same_make():
    traces = []

    @jax.jit
    def run(surface, pose):
        traces.append(None)
        return scan(surface, Camera(height=8, width=8), pose).mask

    for radius in (0.5, 0.7):
        run(SDFSurface(Sphere(radius) | Box([radius, 0.2, 0.3])), look_at([0.0, math.sqrt(2.0), 2.0 * radius]))
    assert len(traces) == 1


def test_operators_give_the_named_solids():
    assert isinstance(Sphere(1.0) & Sphere(2.0), Intersection)
