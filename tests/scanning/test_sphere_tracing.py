"""Sphere tracing against closed forms in float64 NumPy, and its derivatives against finite differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from bumps import box_hit, random_rays, sphere_hit

import jaxnbv as nbv
from jaxnbv.scanning.sdf import Cuboid, Sphere, Torus

RNG = np.random.default_rng(0)


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
    "box": (Cuboid([0.7, 0.5, 0.9]), lambda o, d: box_hit(o, d, np.array([0.7, 0.5, 0.9]))[0]),
    "torus": (Torus(0.7, 0.3), lambda o, d: torus_hit(o, d, 0.7, 0.3)),
}


@pytest.mark.parametrize("inside", [False, True])
@pytest.mark.parametrize("name", SOLIDS)
def test_hits_equal_closed_forms(name, inside):
    sdf, expected = SOLIDS[name]
    o, d = random_rays(RNG, 2000)
    if inside:
        o = np.zeros_like(o) + np.float32([0.65 if name == "torus" else 0.1, 0.05, 0.02])
    hits = nbv.SDFSurface(sdf).trace(o, d)
    t = expected(o.astype(float), d.astype(float))
    mask = np.asarray(hits.mask)
    # Only rays near the silhouette may differ: 0.2 % of them.
    assert (mask != np.isfinite(t)).mean() <= 0.002
    both = mask & np.isfinite(t)
    assert both.sum() > 500
    error = np.linalg.norm(np.asarray(hits.points) - (o + t[:, None] * d), axis=1)[both]
    facing = -np.sum(np.asarray(hits.normals) * d, axis=1)[both]
    # The rounding of the distance, 4e-7, divided by the sine of the angle between ray and surface.
    error = (error * facing)[facing > 0.02]
    assert np.quantile(error, 0.995) < 2e-6
    assert error.max() < 1e-4  # The last chord may end on the wrong side of a sharp edge.
    assert (facing >= 0).all()
    np.testing.assert_allclose(np.linalg.norm(np.asarray(hits.normals)[mask], axis=1), 1.0, atol=1e-5)
    assert not np.asarray(hits.points)[~mask].any()
    assert not np.asarray(hits.normals)[~mask].any()


def test_normals_of_the_sphere_are_radial_and_turned_to_the_sensor():
    o, d = random_rays(RNG, 2000)
    outer = nbv.SDFSurface(Sphere(0.9)).trace(o, d)
    mask = np.asarray(outer.mask)
    # The normal is taken 1e-5 before the hit, which turns a grazing ray's normal by as much.
    np.testing.assert_allclose(outer.normals[mask], outer.points[mask] / 0.9, atol=2e-5)
    inner = nbv.SDFSurface(Sphere(0.9)).trace(np.zeros_like(o), d)
    assert bool(inner.mask.all())
    np.testing.assert_allclose(inner.normals, -inner.points / 0.9, atol=2e-5)


def test_vmapped_scenes_equal_single_scenes():
    sizes = jnp.asarray(RNG.uniform(0.3, 0.9, (5, 2)), dtype=jnp.result_type(float))

    def build(size):
        box = Cuboid(jnp.stack([size[0], 0.4 * jnp.ones(()), size[1]]), 0.05)
        return box | Sphere(size[1]).translate(jnp.stack([size[0], size[0], 0.0 * size[0]]))

    camera, poses = nbv.Camera(height=20, width=20, fov=0.7), nbv.look_at(nbv.geometry.fibonacci_sphere(5, 2.5))
    batch = jax.vmap(lambda size: nbv.SDFSurface(build(size)))(sizes)
    clouds = jax.jit(jax.vmap(lambda surface, pose: nbv.scan(surface, camera, pose)))(batch, poses)
    for i in (0, 3):
        alone = jax.jit(nbv.scan)(nbv.SDFSurface(build(sizes[i])), camera, poses[i])
        assert bool((clouds[i].mask == alone.mask).all())
        np.testing.assert_allclose(clouds[i].points, alone.points, atol=1e-5)
        np.testing.assert_allclose(clouds[i].normals, alone.normals, atol=1e-4)


def test_normals_on_flat_faces_survive_compilation():
    """On a face the slopes of a box come from one of two cases. Rounding must lose neither both nor the unit length."""
    surface = nbv.SDFSurface(Sphere(0.7) | Cuboid([0.4, 0.3, 0.8]).translate([0.3, 0.2, 0.0]))
    cloud = jax.jit(lambda pose: nbv.scan(surface, nbv.Camera(height=16, width=16), pose))(
        nbv.look_at(nbv.geometry.fibonacci_sphere(12, 2.5))
    )
    assert int(cloud.count.sum()) > 2000
    lengths = np.linalg.norm(np.asarray(cloud.normals)[np.asarray(cloud.mask)], axis=1)
    np.testing.assert_allclose(lengths, 1.0, atol=1e-5)
