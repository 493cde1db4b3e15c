"""Samples and candidates shared among eight devices have the values of a single device, and each device has its share
of the work."""

import subprocess
import sys
import textwrap

PROGRAM = """
    import contextlib
    import dataclasses

    import jax

    jax.config.update("jax_num_cpu_devices", 8)
    import jax.numpy as jnp
    import numpy as np
    from jax.sharding import AxisType, Mesh

    import jaxnbv as nbv
    from jaxnbv.sharding import run_sharded, shared_map


    def on(devices, kind=AxisType.Auto):
        mesh = Mesh(jax.devices()[:devices], "devices", axis_types=(kind,))
        return jax.set_mesh(mesh) if devices > 1 else contextlib.nullcontext()


    # What each device is given.
    seen = []
    with on(8):
        for count in (20, 8, 3):
            jax.eval_shape(lambda x: run_sharded(lambda own: seen.append(len(own)) or own, x), jnp.zeros((count, 2)))
        x, y = jnp.linspace(0.0, 1.0, 20), jnp.array([2.0, 3.0])
        loss = lambda x, y: jnp.sum(shared_map(lambda a, b: jnp.sin(a * b).sum(), x, y) ** 2)
        slopes = jax.jit(jax.grad(loss, (0, 1)))(x, y)
    with on(8, AxisType.Explicit):
        jax.eval_shape(lambda x: run_sharded(lambda own: seen.append(len(own)) or own, x), jnp.zeros((20, 2)))
    assert seen == [3, 1, 3, 20], seen
    total = jnp.sin(x[:, None] * y)
    inner = 2 * total.sum(1, keepdims=True) * jnp.cos(x[:, None] * y)
    np.testing.assert_allclose(slopes[0], (inner * y).sum(1), rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(slopes[1], (inner * x[:, None]).sum(0), rtol=1e-5, atol=1e-5)

    camera, first, key = nbv.Camera(height=12, width=12), nbv.look_at((0.3, 1.0, 2.3)), jax.random.key(1)
    # Few values, since each device solves for all of them.
    model = nbv.ScreenedSPSR(nbv.GeometricSPSR(0.05, truncation=8), (nbv.surfaces.OutsideBoundary(num_points=40),))
    sampler = nbv.SurfaceSampler(model, nbv.Grid(24), num_samples=9)
    planner = nbv.Planner(nbv.NewSurface(), nbv.DiscreteSearch(20), camera, sampler, capacity=64)
    halving = dataclasses.replace(planner, search=nbv.HalvingSearch(20))
    observations = planner.init(first, nbv.scan(nbv.SDFSurface(nbv.sdf.Sphere(0.8)), camera, first))
    alone = planner.choose(planner.step_inputs(observations, key), key)
    with on(8):
        inputs = planner.step_inputs(observations, key)
        together, halved = (one.choose(inputs, key) for one in (planner, halving))
    assert len(together.value.sharding.device_set) == len(halved.value.sharding.device_set) == 8
    np.testing.assert_allclose(together.values, alone.values, rtol=1e-5)
    np.testing.assert_allclose(together.pose.matrix, alone.pose.matrix, atol=1e-4)
    # The last two candidates of halving are scored on all samples, and the first ten on four or more.
    same = np.isclose(halved.values, alone.values, rtol=1e-5)
    assert 2 <= same.sum() < 20
    assert same[np.flatnonzero(halved.values == halved.value)].all()
    assert np.abs(halved.values - alone.values).max() < 0.5 * np.ptp(alone.values)
"""


def test_eight_devices_agree_with_one(tmp_path):
    """In its own process, because the number of devices must be set before JAX starts."""
    program = tmp_path / "program.py"
    program.write_text(textwrap.dedent(PROGRAM))
    ended = subprocess.run([sys.executable, program], capture_output=True, text=True, timeout=600)
    assert ended.returncode == 0, ended.stderr
