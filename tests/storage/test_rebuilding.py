"""A configuration from a folder equals the stored one, and reading it runs no code."""

import enum
import functools
import json
import shutil
import sys
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import hostile
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from hypothesis import given, settings
from small_episode import BASE
from small_planner import MODEL, SOLID

import jaxnbv as nbv
from jaxnbv import readers
from jaxnbv.checks import InputError
from jaxnbv.networks.pretrained import part_segmenter, pretrained_classifier
from jaxnbv.storage import RunFolder, describe, rebuild

SPHERE = nbv.mesh_from_sdf(nbv.sdf.Sphere(0.7), nbv.Grid(16))
GRID = nbv.Grid(8)


class Kind(enum.Enum):
    SMALL = "small"


class Pair(NamedTuple):
    type_of: Kind
    place: Path


class Mine(eqx.Module):
    net: eqx.Module
    held: Any = eqx.field(static=True)

    def worth(self, cloud):
        return jnp.sum(self.net(cloud.points[0]))


def utility(cloud):
    return jnp.sum(cloud.points)


by_name = lambda cloud: jnp.sum(cloud.normals)  # noqa: E731
KEY = jax.random.key(3)
MLP = eqx.nn.MLP(3, 2, 8, 1, key=KEY)
WITH_BANK = nbv.SurfaceSampler(nbv.ScreenedSPSR(MODEL, (nbv.surfaces.OnSurface(20),)), GRID, 2).with_bank(
    nbv.ShapeBank.of([nbv.sdf.Sphere(0.5), nbv.sdf.Sphere(0.6)]), nbv.surfaces.Upright()
)
COARSE = nbv.SurfaceSampler(MODEL, nbv.Grid(9, half_extent=1.6), 2)
OBSTACLES = nbv.Obstacles((nbv.sdf.Sphere(0.1),))


def planned(acquisition, search=nbv.DiscreteSearch(6), sampler=COARSE, **changes):  # noqa: B008
    camera = nbv.Camera(height=4, width=5)
    return nbv.Planner(acquisition, search, camera, sampler, obstacles=OBSTACLES, **changes)


def improvement(function):
    return nbv.ExpectedUtilityImprovement(function)


CONFIGURATIONS = {
    "episode": lambda: BASE,
    "classifier and bank": lambda: planned(
        nbv.CrossEntropy(pretrained_classifier("pyramid"), 64), sampler=WITH_BANK, capacity=77
    ),
    "shipped bank": lambda: nbv.shape_bank("parts"),
    "segmenter": lambda: nbv.SoftPartCount(part_segmenter("table")),
    "utility": lambda: planned(improvement(utility), cost=nbv.ValuePerCost(nbv.arc_length)),
    "named lambda": lambda: improvement(by_name),
    "partial": lambda: improvement(functools.partial(jnp.power, 2.0)),
    "wrapper": lambda: improvement(eqx.filter_vmap(utility, in_axes=eqx.if_array(0))),
    "method": lambda: improvement(Mine(MLP, (1, 2.0)).worth),
    "networks": lambda: (MLP, eqx.nn.Sequential([eqx.nn.Linear(3, 3, key=KEY), eqx.nn.Lambda(jax.nn.relu)])),
    "gradient": lambda: nbv.GradientSearch(dof=6, num_starts=2, solver=optx.BFGS(1e-3, 1e-3)),
    "solids": lambda: (SOLID, nbv.SDFSurface(SOLID), nbv.sdf.solid_of_mesh(SPHERE.vertices, SPHERE.faces)),
    "sampled grid": lambda: nbv.scanning.GridSurface.from_values(
        jnp.linspace(-1.0, 1.0, 512).reshape(8, 8, 8), 0.0, GRID
    ),
    "own": lambda: Mine(MLP, Pair(Kind.SMALL, Path("a"))),
    "arrays": lambda: (
        [np.zeros((0, 3)), np.arange(60.0), np.float32(0.1), np.array(7, np.int8), True, 1, 1.0, None, "a"],
        ({1: (), 2.5: {3, 4}, float("inf"): frozenset({"a"})}, {"type": [], "b": b"x", "c": 1j}),
        {"weak": jnp.asarray(2.0), "half": jnp.ones(3, jnp.bfloat16), "nan": jnp.array([jnp.nan, -0.0])},
        (jax.random.key(7, impl="rbg"), jax.random.split(KEY, 3), np.dtype("float32")),
    ),
}


def trip(thing):
    arrays = {}
    description = describe(thing, arrays, "planner")
    return rebuild(json.loads(json.dumps(description)), arrays, "planner")


def assert_same(one, other):
    assert jax.tree.structure(one) == jax.tree.structure(other)
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        assert type(a) is type(b)
        if isinstance(a, np.ndarray | np.generic | jax.Array):
            assert (a.dtype, a.shape, getattr(a, "weak_type", None)) == (
                b.dtype,
                b.shape,
                getattr(b, "weak_type", None),
            )
            if jnp.issubdtype(a.dtype, jax.dtypes.prng_key):
                a, b = jax.random.key_data(a), jax.random.key_data(b)
            assert np.asarray(a).tobytes() == np.asarray(b).tobytes()
        else:
            assert a == b or describe(a) == describe(b)


@pytest.mark.parametrize("name", CONFIGURATIONS)
def test_a_described_value_is_rebuilt(name):
    thing = CONFIGURATIONS[name]()
    assert_same(thing, trip(thing))


@pytest.mark.slow
def test_every_public_class_is_rebuilt():
    skipped, count = {nbv.shape_bank, nbv.load_mesh, nbv.ShapeBank.from_meshes, readers.class_meshes}, 0
    for function, arguments in hostile.CALLS.items():
        if function not in skipped:
            thing = function(**arguments)
            assert_same(as_arrays(thing), as_arrays(trip(thing)))
            count += 1
    assert count > 60


def as_arrays(thing):
    """The mesh without its tree, which differs between objects."""
    return (thing.vertices, thing.faces, thing.frame) if isinstance(thing, nbv.TriangleMesh) else thing


def test_a_mesh_that_was_made_again_is_scanned_the_same():
    pose, camera = nbv.look_at((0.5, 0.6, 2.4)), nbv.Camera(height=8, width=8)
    again = trip(SPHERE)
    assert_same(as_arrays(SPHERE), as_arrays(again))
    assert_same(nbv.scan(SPHERE, camera, pose), nbv.scan(again, camera, pose))


PLAIN = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats()
    | st.complex_numbers()
    | st.text()
    | st.binary()
    | st.builds(np.float32, st.floats(width=32))
    | st.lists(st.floats(width=32), max_size=20).map(lambda numbers: np.array(numbers, np.float32)),
    lambda inner: (
        st.lists(inner)
        | st.lists(inner).map(tuple)
        | st.dictionaries(st.text() | st.just("type") | st.integers(), inner)
        | st.builds(Pair, inner, inner)
    ),
    max_leaves=12,
)


@settings(max_examples=40)
@given(PLAIN)
def test_any_plain_value_comes_back(value):
    arrays = {}
    description = describe(value, arrays)
    again = rebuild(json.loads(json.dumps(description)), arrays, "planner")
    assert repr(again) == repr(value)
    assert describe(again) == description


@pytest.mark.parametrize(
    ("told", "problem"),
    [
        ({"type": "function", "name": "os:system"}, "os:system, which no configuration .* may call"),
        ({"type": "function", "name": "jaxnbv.storage.files:os.system"}, "os.system, but|has changed"),
        ({"type": "function", "name": "jax.numpy:load"}, "may call"),
        ({"type": "function", "name": "numpy:save"}, "may call"),
        ({"type": "class", "name": "subprocess:Popen"}, "may call"),
        ({"type": "subprocess:Popen", "args": "true"}, "no dataclass"),
        ({"type": "antigravity:Thing"}, "antigravity is not imported"),
        ({"type": "function", "name": "antigravity:geohash"}, "antigravity is not imported"),
        ({"type": "jaxnbv.__main__:main"}, "not imported|no dataclass|nothing of that name"),
        (
            {
                "type": "partial",
                "function": {"type": "function", "name": "os:system"},
                "arguments": ["a"],
                "keywords": {},
            },
            "may call",
        ),
        ({"type": "jaxnbv.geometry.camera:Camera"}, "stored without its fov"),
        ({"type": "jax float32", "shape": [20], "sha256": "0"}, "an array that the folder does not hold"),
        ({"type": "jax float32", "values": "x"}, "cannot be made again"),
        ({"type": 7}, "cannot be made again"),
        ({"type": "list"}, "cannot be made again"),
    ],
)
def test_a_record_that_names_other_code_is_refused_and_nothing_runs(told, problem):
    before = set(sys.modules)
    with pytest.raises(InputError, match=rf"^planner.*({problem}).*load\(\.\.\., planner=\.\.\.\)"):
        rebuild(told, {}, "planner")
    assert {name for name in sys.modules if "antigravity" in name or name == "jaxnbv.__main__"} <= before


@pytest.mark.parametrize(
    ("thing", "problem"),
    [
        (lambda cloud: jnp.sum(cloud.points), "<lambda>, but .* has nothing of that name"),
        (jax.jit(utility), "PjitFunction of .*utility that has no name of its own"),
        (nbv.HostClassifier(len, 2, version="a"), r"stored without its function"),
    ],
)
def test_a_value_that_cannot_be_rebuilt_is_named_with_the_remedy(thing, problem):
    with pytest.raises(InputError, match=rf"^planner.*{problem}.*give it again: load\(\.\.\., planner="):
        trip({"score": thing})


def test_a_function_that_has_changed_is_refused(monkeypatch):
    arrays, description = {}, describe(improvement(utility))
    monkeypatch.setattr(sys.modules[__name__], "utility", by_name)
    with pytest.raises(InputError, match=r"has changed"):
        rebuild(description, arrays, "planner")


def stored(path, **changes):
    config = {"planner": planned(improvement(utility)), "scene": SPHERE, "key": KEY} | changes
    folder = RunFolder(path, "episode", config)
    folder.write("view", 0, depth=np.zeros((2, 2)))
    return config


def test_a_folder_gives_its_configuration_back(tmp_path):
    config = stored(tmp_path)
    again = RunFolder.config_of(tmp_path, "episode")
    assert_same({**config, "scene": as_arrays(SPHERE)}, {**again, "scene": as_arrays(again["scene"])})
    assert RunFolder(tmp_path, "episode", again).count("view") == 1
    planner = planned(improvement(by_name))
    assert RunFolder.config_of(tmp_path, "episode", planner=planner)["planner"] is planner
    with pytest.raises(InputError, match="another episode"):
        RunFolder(tmp_path, "episode", again | {"planner": planner})


def test_damaged_arrays_are_refused_by_name(tmp_path):
    stored(tmp_path / "whole")
    whole = (tmp_path / "whole" / "arrays.npz").read_bytes()
    with np.load(tmp_path / "whole" / "arrays.npz") as saved:
        arrays = dict(saved)
    for index, size in enumerate((0, 100, len(whole) // 2)):
        folder = shutil.copytree(tmp_path / "whole", tmp_path / str(index))
        (folder / "arrays.npz").write_bytes(whole[:size])
        with pytest.raises(InputError, match=r"arrays\.npz is damaged .*restore it"):
            RunFolder.config_of(folder, "episode")
    name, array = next(iter(arrays.items()))
    np.savez_compressed(tmp_path / "whole" / "arrays.npz", **(arrays | {name: array + 1}))
    with pytest.raises(InputError, match=rf"arrays\.npz is damaged \(the array {name} is another\)"):
        RunFolder.config_of(tmp_path / "whole", "episode")
    (tmp_path / "whole" / "arrays.npz").unlink()
    with pytest.raises(InputError, match=r"scene\.vertices is an array that the folder does not hold"):
        RunFolder.config_of(tmp_path / "whole", "episode")
