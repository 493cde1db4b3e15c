"""What a record says of the settings: the same for the same, another for any other."""

import functools
import json
import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_episode import BASE
from small_planner import planner_of

from jaxnbv.geometry.pose import look_at
from jaxnbv.scanning import Grid, SDFSurface, SensorNoise
from jaxnbv.scanning.sdf import Capsule, Sphere
from jaxnbv.search import DiscreteSearch, FarthestView, SphereCandidates
from jaxnbv.storage import describe
from jaxnbv.surfaces import GeometricSPSR

CHANGES = {
    "model": {"planner": planner_of(model=GeometricSPSR(truncation=8, lengthscale=0.051))},
    "search": {"planner": planner_of(FarthestView(12))},
    "candidates": {"planner": planner_of(DiscreteSearch(13))},
    "radius": {"planner": planner_of(DiscreteSearch(SphereCandidates(12, 2.6)))},
    "samples": {"planner": planner_of(num_samples=4)},
    "grid": {"planner": planner_of(grid=Grid(25))},
    "capacity": {"planner": planner_of(capacity=129)},
    "scene": {"scene": SDFSurface(Sphere(0.7))},
    "one number of the scene": {"scene": SDFSurface(Sphere(0.7) | Capsule([0.2, 0.3, -0.4], [0.5, 0.6, 0.9], 0.31))},
    "noise": {"noise": SensorNoise(points=0.02)},
    "first": {"first": look_at((0.8, 0.9, 2.3))},
    "key": {"key": jax.random.key(1)},
    "kind of key": {"key": jax.random.key(0, impl="rbg")},
}


@pytest.mark.parametrize("name", CHANGES)
def test_a_description_tells_every_setting_apart(name):
    assert json.dumps(describe(BASE)) == json.dumps(describe(dict(BASE)))
    assert json.dumps(describe(BASE | CHANGES[name])) != json.dumps(describe(BASE))


def test_a_description_tells_large_arrays_and_functions_apart():
    large = np.zeros((40, 3))
    other = large.copy()
    other[17, 1] = 1e-300
    assert describe(large) == describe(large.copy())
    assert describe(large) != describe(other)
    assert describe(large) != describe(large.reshape(3, 40))
    assert describe(jnp.sin) != describe(jnp.cos)
    assert describe(lambda x: x + 1) != describe(lambda x: x + 2)

    def plus(amount, default=0):
        return lambda x, y=default: (lambda z: z + x + y)(amount)

    assert describe(plus(1.0)) == describe(plus(1.0))
    assert describe(plus(1.0)) != describe(plus(2.0))
    assert describe(plus(1.0, 1)) != describe(plus(1.0, 2))
    assert describe(functools.partial(plus, 1)) != describe(functools.partial(plus, 2))
    assert describe(jax.jit(plus(1.0))) != describe(jax.jit(plus(2.0)))
    assert json.loads(json.dumps(describe({"a": (1, 2.5, None, "x", large)})))["a"][:4] == [1, 2.5, None, "x"]


@pytest.mark.slow
def test_a_description_of_a_function_is_the_same_in_every_process(tmp_path):
    (tmp_path / "mine.py").write_text("def utility(x):\n    return x in {'a', 'b', 'c'} and (lambda: 1)\n")
    code = "from jaxnbv.storage import describe; from mine import utility; print(describe(utility))"
    outputs = set()
    for seed in ("1", "2", "3"):
        environment = {**os.environ, "PYTHONHASHSEED": seed, "PYTHONPATH": str(tmp_path)}
        outputs.add(
            subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, check=True).stdout
        )
    assert len(outputs) == 1
    assert b"return x in" in outputs.pop()


def test_a_function_without_source_is_known_by_its_name_and_says_so():
    namespace = {}
    exec("def utility(x):\n    return x", namespace)
    with pytest.warns(UserWarning, match=r"source of the function utility cannot be read.*Define it in a file"):
        told = describe(namespace["utility"])
    assert told["function"] == "utility"
    assert told["source"] is None
