"""The studies of trucks, household objects and fruits on a small scale: what they record beside the pyramids'."""

import functools
import json

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

from jaxnbv.camera import Camera
from jaxnbv.datasets import Split, truck_scene
from jaxnbv.experiments.charts import write_charts
from jaxnbv.experiments.classification.modelnet10 import ModelNet10Study
from jaxnbv.experiments.classification.omniobject3d import OmniObject3DStudy
from jaxnbv.experiments.classification.pictures import write_pictures
from jaxnbv.experiments.classification.truck import TruckStudy
from jaxnbv.experiments.measures import values
from jaxnbv.experiments.tables import summary, write_tables
from jaxnbv.scanning import SDFSurface, scan
from jaxnbv.search import FarthestView
from jaxnbv.search.candidates import sphere_candidates
from jaxnbv.surfaces import GeometricSPSR
from jaxnbv.tasks import Coverage

SCENE, CANDIDATES = 4, 12


class Linear(eqx.Module):
    """An opinion from the means of points and normals."""

    classes: int = eqx.field(static=True)

    def __call__(self, cloud):
        rows = jnp.concatenate([cloud.points, cloud.normals], axis=-1)
        mean = jnp.sum(jnp.where(cloud.mask[:, None], rows, 0.0), axis=0) / jnp.maximum(cloud.count, 1)
        weight = jnp.asarray(np.random.default_rng(1).normal(size=(self.classes, 6)), mean.dtype)
        return jax.nn.log_softmax(2.0 * weight @ mean)


def small(kind, **settings):
    few = {"num_candidates": CANDIDATES, "num_samples": 2, "grid_resolution": 20, "capacity": 250, "num_points": 100}
    model = GeometricSPSR(lengthscale=0.05, truncation=8)
    return kind(classifier=Linear(len(kind.objects.classes)), model=model, views=3, **few, **settings)


@functools.cache
def record(kind):
    return json.loads(json.dumps(small(kind).run_scene(SCENE), allow_nan=False))


def test_of_a_truck_the_pixels_of_its_cargo_are_recorded():
    found, truck = record(TruckStudy), truck_scene(Split.TEST, SCENE)
    assert list(found["methods"]) == list(TruckStudy.methods)
    assert found["label"] == int(truck.label) == SCENE
    poses = sphere_candidates(CANDIDATES, 2.5)
    seen = scan(SDFSurface(truck), Camera(), poses)
    cargo = np.asarray(jnp.sum((jnp.abs(truck.cargo(seen.points)) < 2e-3) & seen.mask, axis=-1))
    np.testing.assert_allclose(found["cargo_pixels"], cargo, atol=2)
    assert cargo.max() > 150 > cargo.min() == 0
    for held in found["methods"].values():
        for run in held["runs"]:
            assert run["cargo_pixels"] == [found["cargo_pixels"][index] for index in run["candidates"]]
            assert np.shape(run["log_p"]) == (3, 10)
    shown = values([found], list(TruckStudy.methods), TruckStudy.measure("cargo"))[0]
    for name, row in zip(TruckStudy.methods, shown, strict=True):
        if name != "random":
            pixels = found["methods"][name]["runs"][0]["cargo_pixels"]
            np.testing.assert_array_equal(row, np.maximum.accumulate(np.array(pixels) >= 150))


def test_first_views_of_trucks_are_random_and_told_apart_by_what_they_show():
    study = small(TruckStudy)
    firsts = [study.first_view(study.scene(index)) for index in range(12)]
    assert len({*firsts}) > 5
    shown = [record(TruckStudy) | {"first": int(np.argmax(record(TruckStudy)["cargo_pixels"]))}]
    hidden = [record(TruckStudy) | {"first": int(np.argmin(record(TruckStudy)["cargo_pixels"]))}]
    groups = TruckStudy.groups(shown + hidden)
    assert groups == {"all": shown + hidden, "first view without cargo": hidden, "first view with cargo": shown}
    assert {*TruckStudy.groups(shown)} == {"all", "first view with cargo"}


@pytest.mark.parametrize("kind", [ModelNet10Study, OmniObject3DStudy])
def test_where_all_of_the_object_tells_its_class_no_pixels_are_counted(kind):
    found = record(kind)
    assert list(found["methods"]) == list(kind.methods)
    assert found["label"] == SCENE % len(kind.objects.classes)
    assert not [key for key in found if "pixels" in key]
    for name, held in found["methods"].items():
        assert [*held["runs"][0]] == ["candidates", "log_p"]
        for entry in held["diagnostics"]:
            assert entry["rank_correlation"] is None
            assert (entry["roughness"] is None) == (name in ("farthest", "oracle"))
    assert {*kind.groups([found])} == {"all"}


@pytest.mark.parametrize("kind", [TruckStudy, ModelNet10Study, OmniObject3DStudy])
def test_tables_charts_and_pictures(kind, tmp_path):
    text = summary([record(kind)], kind)
    assert kind.title in text
    assert "Stable hit" in text
    paths = [*write_tables([record(kind)], kind, tmp_path), *write_charts([record(kind)], kind, tmp_path)]
    assert all(path.stat().st_size > 0 for path in paths)
    (picture,) = write_pictures([record(kind)], small(kind), tmp_path, pixels=40)
    with Image.open(picture) as image:
        assert np.asarray(image.convert("L")).std() > 5


def test_a_method_of_ones_own_on_household_objects():
    def own(study, scene):
        return study.planner_of(Coverage(), FarthestView(study.candidates))

    found = small(ModelNet10Study).run_scene(SCENE, ("farthest",), {"mine:own": own})["methods"]
    (ours,), (theirs,) = found["mine:own"]["runs"], found["farthest"]["runs"]
    np.testing.assert_allclose(ours["log_p"], theirs["log_p"], atol=1e-5)
