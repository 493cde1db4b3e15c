"""Descriptions of settings in records: equal for equal settings, and different for any others."""

import functools
import importlib
import json
import linecache
import os
import subprocess
import sys

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_episode import BASE
from small_planner import planner_of

import jaxnbv as nbv
from jaxnbv.checks import InputError
from jaxnbv.scanning import Grid, SDFSurface
from jaxnbv.scanning.sdf import Capsule, Sphere
from jaxnbv.search import DiscreteSearch, SphereCandidates
from jaxnbv.storage import describe
from jaxnbv.surfaces import GeometricSPSR

# Other changes are in `test_a_folder_of_another_configuration_is_refused`.
CHANGES = {
    "model": {"planner": planner_of(model=GeometricSPSR(truncation=8, lengthscale=0.051))},
    "radius": {"planner": planner_of(DiscreteSearch(SphereCandidates(12, 2.6)))},
    "grid": {"planner": planner_of(grid=Grid(25))},
    "capacity": {"planner": planner_of(capacity=129)},
    "one number of the scene": {"scene": SDFSurface(Sphere(0.7) | Capsule([0.2, 0.3, -0.4], [0.5, 0.6, 0.9], 0.31))},
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


def write_module(folder, monkeypatch, name, text):
    """Write and import a user's module."""
    (folder / f"{name}.py").write_text(text)
    monkeypatch.syspath_prepend(folder)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    sys.modules.pop(name, None)
    linecache.clearcache()
    return importlib.import_module(name)


class Net:
    """Weights that the description cannot see, as in a network of another library."""

    def __init__(self, weight):
        self.weight = weight

    def __call__(self, points, normals, mask):
        return np.log([[self.weight, 1.0 - self.weight]] * len(points))


def planner_with(classifier):
    return {"planner": planner_of(score=nbv.CrossEntropy(classifier, num_points=16))}


def test_a_network_of_another_library_needs_a_version():
    with pytest.raises(InputError, match=r"^planner\.acquisition\.classifier\.function is a Net, .*version"):
        describe(planner_with(nbv.HostClassifier(Net(0.2), 2)))
    first, same, other = (
        describe(planner_with(nbv.HostClassifier(Net(weight), 2, version=version)))
        for weight, version in ((0.2, "2026-11"), (0.3, "2026-11"), (0.2, "2026-12"))
    )
    assert first == same != other
    assert other != describe(planner_with(nbv.HostClassifier(Net(0.2), 3, version="2026-12")))
    assert describe(nbv.HostSegmenter(len, 2, version="a")) != describe(nbv.HostSegmenter(len, 2, version="b"))
    first, other = Net(0.2), Net(0.3)
    first.version, other.version = 1, 2
    assert describe(nbv.HostClassifier(first, 2)) != describe(nbv.HostClassifier(other, 2))


def test_bound_methods_of_different_objects_are_told_apart():
    one, other = (nbv.SphereCandidates(6, radius) for radius in (2.5, 2.6))
    assert describe(one.poses) == describe(one.poses) != describe(other.poses)
    with pytest.raises(InputError, match="a Net"):
        describe(Net(0.1).__call__)


HELPER = """
WEIGHTS = [1.0, {weight}]

class Scorer:
    bias = {bias}

    def score(self, x):
        return x + self.bias
"""
MINE = """
import numpy as np
import helper

def inner(x):
    return inner(x - 1) if x > 3 else [WEIGHT * y for y in helper.WEIGHTS]

WEIGHT = np.arange(40.0)

def utility(x):
    return inner(x) or helper.Scorer().score(x)
"""


def test_whatever_a_function_reads_tells_it_apart(tmp_path, monkeypatch):
    def described(weight=2.0, bias=0.5, replaced=("", "")):
        write_module(tmp_path, monkeypatch, "helper", HELPER.format(weight=weight, bias=bias))
        return describe(write_module(tmp_path, monkeypatch, "mine", MINE.replace(*replaced)).utility)

    usual = described()
    assert json.loads(json.dumps(usual)) == described()
    others = [
        described(weight=3.0),
        described(bias=0.25),
        described(replaced=("arange(40.0)", "arange(41.0)")),
        described(replaced=("x > 3", "x > 4")),
    ]
    assert len({json.dumps(other) for other in [usual, *others]}) == 5
    mine = sys.modules["mine"]
    before = describe(mine.utility)
    mine.WEIGHT[17] = 0.0
    assert describe(mine.utility) != before


def test_a_users_class_is_told_apart_by_its_methods():
    def acquisition(number):
        class Mine(eqx.Module):
            weight: float = 1.0

            def score(self, scan):
                return self.weight * number

        return Mine()

    assert describe(acquisition(1)) == describe(acquisition(1)) != describe(acquisition(2))


def test_a_value_that_refers_to_itself_is_described():
    loops = []
    for number in (1.0, 2.0):
        loop = [number]
        loop.append(loop)
        loops.append(loop)
    assert describe(loops[0]) != describe(loops[1])

    def even(x):
        return x == 0 or odd(x - 1)

    def odd(x):
        return x != 0 and even(x - 1)

    assert describe(even) != describe(odd)


def test_a_function_whose_source_cannot_be_read_needs_a_version():
    namespace = {}
    exec("def utility(x):\n    return x", namespace)
    utility = namespace["utility"]
    with pytest.raises(InputError, match=r"^planner\.score is the function utility, whose source cannot .*: define"):
        describe({"planner": {"score": utility}})
    utility.version = 1
    first = describe(utility)
    utility.version = 2
    assert first != describe(utility)


def test_a_function_that_imports_a_users_module_is_refused(tmp_path, monkeypatch):
    write_module(tmp_path, monkeypatch, "weights_of_mine", "VALUE = 1")
    text = "def utility(x):\n    import weights_of_mine\n    return weights_of_mine.VALUE\n"
    mine = write_module(tmp_path, monkeypatch, "mine", text)
    with pytest.raises(InputError, match="imports weights_of_mine while it runs: import it at the top"):
        describe(mine.utility)


@pytest.mark.parametrize(
    "transform", [jax.jit, eqx.filter_jit, jax.vmap, eqx.filter_vmap, jax.grad, eqx.filter_grad, functools.lru_cache]
)
def test_transformed_functions_are_told_apart(transform):
    one, same, other = (transform(lambda x, y=y: x + y) for y in (1.0, 1.0, 2.0))
    assert describe(one) == describe(same) != describe(other)
