"""The engine of studies, with a minimal study."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from toy import ToyStudy

from jaxnbv.checks import InputError
from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.pose import look_at
from jaxnbv.planning.planner import Planner
from jaxnbv.planning.simulate import simulate
from jaxnbv.sampler import SurfaceSampler
from jaxnbv.scanning import SDFSurface, SensorNoise
from jaxnbv.search import (
    ConstrainedPoses,
    DiscreteSearch,
    FreePoses,
    GivenPoses,
    GradientSearch,
    HalvingSearch,
    HybridSearch,
    RandomView,
    SpherePoses,
)
from jaxnbv.studies.engine.run import replay, run_scene
from jaxnbv.surfaces import GeometricSPSR
from jaxnbv.tasks import Coverage

SAMPLER = SurfaceSampler(GeometricSPSR(0.05, truncation=4))


def small(kind=ToyStudy, **settings):
    few = {"views": 3, "num_candidates": 8, "num_samples": 2, "sampler": SAMPLER}
    fine = {"grid_resolution": 16, "camera": Camera(height=12, width=12), "capacity": 500}
    return kind(**(few | fine | settings))


def without_time(record):
    """The record without seconds, at any depth."""
    if isinstance(record, list):
        return [without_time(one) for one in record]
    if isinstance(record, dict):
        return {key: without_time(value) for key, value in record.items() if key != "seconds"}
    return record


def test_a_record_is_json_and_methods_share_the_first_view():
    study = small()
    record = run_scene(study, 3)
    assert json.loads(json.dumps(record, allow_nan=False)) == record
    assert (record["scene"], record["name"], record["study_views"]) == (3, "ball 3", 3)
    assert list(record["methods"]) == ["farthest", "random"]
    runs = [*record["methods"].values()]
    assert [len(run["views"]) for run in runs] == [3, 3]
    assert runs[0]["views"][0] == runs[1]["views"][0]
    assert runs[0]["points"][0] == runs[1]["points"][0]
    first = study.candidates.poses()[record["first"]]
    assert runs[0]["views"][0]["position"] == first.position.tolist()
    assert without_time(run_scene(study, 3)) == without_time(record)
    assert without_time(run_scene(study, 3, ["random"])["methods"]) == without_time({"random": runs[1]})
    assert run_scene(study, 4)["first"] != record["first"] or run_scene(study, 5)["first"] != record["first"]


def test_the_same_views_are_scanned_again_from_a_record():
    study = small()
    scene, run = study.scene(0), run_scene(study, 0)["methods"]["farthest"]
    steps = replay(study, scene, run)
    assert [int(observations.cloud.count) for _, observations in steps] == run["points"]
    scans = [scan for scan, _ in steps]
    assert int(scans[0].count) + int(scans[1].count) == run["points"][1]
    # The scans have noise.
    distance = np.abs(np.linalg.norm(scans[0].to_numpy()[0], axis=1) - 1.0)
    assert 1e-4 < distance.mean() < 0.05


def test_a_study_takes_the_views_of_a_simulation():
    """Bit for bit. Sessions have the same loop (`test_a_session_proposes_as_a_simulation_does`)."""
    study = small()

    def discrete(study, scene) -> Planner:
        return study.planner_of(Coverage(), DiscreteSearch(study.candidates), scene)

    record = run_scene(study, 1, methods=[], own={"discrete": discrete})
    scene, first = study.scene(1), study.candidates.poses()[record["first"]]
    key, noise = study.key(1, "episode"), SensorNoise()
    episode = simulate(discrete(study, scene), scene.surface, first, 3, key, noise, progress=False)
    for view, recorded in zip(episode.views, record["methods"]["discrete"]["views"], strict=True):
        assert view.pose.position.tolist() == recorded["position"]
        assert view.pose.rotation.tolist() == recorded["rotation"]
    assert [int(view.cloud.count) for view in episode.views] == record["methods"]["discrete"]["points"]


def test_a_method_of_ones_own_stands_in_the_same_record():
    study, calls = small(), []

    def above(study, scene) -> Planner:
        calls.append(scene.index)
        poses = look_at(jnp.array([[0.0, 2.5, 0.1], [0.0, -2.5, 0.1], [0.1, 2.5, 0.0]]))
        return study.planner_of(Coverage(), RandomView(GivenPoses(poses)), scene)

    record = run_scene(study, 2, ["random"], {"mine:above": above})
    assert calls == [2]
    assert list(record["methods"]) == ["random", "mine:above"]
    own = record["methods"]["mine:above"]
    assert own["views"][0] == record["methods"]["random"]["views"][0]
    assert {abs(round(view["position"][1], 3)) for view in own["views"][1:]} == {2.5}


def test_a_method_of_ones_own_that_makes_no_planner_is_refused_before_anything_is_run(monkeypatch):
    study = small()
    monkeypatch.setattr(ToyStudy, "follow", lambda *_: pytest.fail("a method was run"))

    def few(study, scene):
        return Planner(Coverage(), RandomView(3), study.camera, study.sampler, max_views=1)

    for make, problem in (
        (lambda study, scene: None, "the planner of the method mine is None; give Planner"),
        (lambda study, scene: 1 / 0, r"the method mine fails on scene 0 \(ZeroDivisionError"),
        (lambda: None, "the method mine fails on scene 0 .*takes 0 positional arguments"),
        (few, rf"a planner for 1 views, but the study has {study.views}: give Planner\(max_views={study.views}\)"),
    ):
        with pytest.raises(InputError, match=problem):
            run_scene(study, 0, ["random"], {"mine": make})


def test_the_first_view_shows_enough():
    class Picky(ToyStudy):
        def shows_enough(self, scene, scan):
            return float(scan.points[scan.mask].mean(axis=0)[1]) > 0.3

    study = small(Picky)
    firsts = {study.first_view(study.scene(index)) for index in range(6)}
    assert len(firsts) > 1
    assert all(float(study.candidates.poses().position[first][1]) > 0.5 for first in firsts)
    never = type("Never", (ToyStudy,), {"shows_enough": lambda *_: False})
    with pytest.raises(InputError, match="none of 3 candidates shows enough of ball 0"):
        run_scene(small(never, views=2, num_candidates=3), 0)


def test_a_method_without_shapes_runs_beside_the_same_with_shapes():
    study = small(type("Twice", (ToyStudy,), {"without_bank": ("random",)}))
    plain, again = run_scene(study, 0, ["random", "random-screened"])["methods"].values()
    assert without_time(plain) == without_time(again)


def test_the_name_of_a_method_tells_its_search():
    """The tests of the searches check what each search proposes."""
    study = small(num_candidates=8, num_starts=2, iterations=3, learning_rate=0.1)
    constrained = ConstrainedPoses(study.radius - 0.3, study.radius + 0.3)
    spaces = {"2dof": SpherePoses(study.radius), "6dof": FreePoses(study.radius), "constrained": constrained}
    expected = {f"gradient-{name}": GradientSearch(None, space, 2, 3, 0.1, 4) for name, space in spaces.items()}
    expected |= {"halving": HalvingSearch(study.candidates), "any other": DiscreteSearch(study.candidates)}
    expected["hybrid"] = HybridSearch(space=SpherePoses(study.radius), candidates=study.candidates)
    for method, search in expected.items():
        assert study.search(method, study.scene(0)) == search


def test_unknown_methods_and_bad_numbers_are_refused():
    with pytest.raises(InputError, match="unknown methods: best; choose from farthest, random"):
        run_scene(small(), 0, ["best", "random"])
    for settings in ({"views": 1}, {"views": 9}):
        with pytest.raises(InputError, match="at least two views"):
            small(**settings)


def test_a_command_configures_it():
    (name, study), *others = ToyStudy.configured("paper", 4, quick=True).items()
    assert (name, others) == ("", [])
    assert (study.views, study.num_samples, study.sampler.carving) == (4, 4, None)
    assert isinstance(study.sampler.model, GeometricSPSR)
    (study,) = ToyStudy.configured("screened", 5, quick=False, num_candidates=20).values()
    assert (study.num_samples, study.num_candidates) == (16, 20)
    assert study.sampler.carving is not None


def test_planners_have_the_studys_settings():
    study = small(sampler=dataclasses.replace(SAMPLER, carving=None))
    planner = study.planner("random", study.scene(0))
    sizes = planner.sampler.num_samples, planner.sampler.grid.resolution, planner.capacity, planner.max_views
    assert sizes == (2, 16, 500, 3)
    assert planner.sampler.carving is None
    assert isinstance(small().scene(0).surface, SDFSurface)
    keys = [small().key(*of) for of in ((0, "first"), (1, "first"), (0, "episode"))]
    assert len({tuple(jax.random.key_data(key).tolist()) for key in keys}) == 3
