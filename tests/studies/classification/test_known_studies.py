"""Studies with known shapes, compared with methods without them."""

import dataclasses

import jax
import numpy as np
import pytest
import trimesh
from test_pyramid_study import CAMERA, SCENE, chosen, observations_of, small_study, step_key, without_time

import jaxnbv as nbv
from jaxnbv.cli.registry import STUDY_MODELS
from jaxnbv.sampler import MODELS
from jaxnbv.studies.classification.objects import PyramidStudy
from jaxnbv.studies.engine.measures import KNOWN
from jaxnbv.studies.engine.run import methods_of, run_scene
from jaxnbv.studies.heat import HeatStudy
from jaxnbv.studies.parts.study import PartStudy
from jaxnbv.studies.registry import studies
from jaxnbv.studies.scenes import Split, pyramid_scene
from jaxnbv.surfaces import GeometricSPSR, KnownShapes, OnSurface, ScreenedSPSR, mesh_shapes
from jaxnbv.surfaces.shipped_banks import SHIPPED_BANKS

METHODS = ("cross-entropy", "coverage", "uncertainty", "coverage-screened", "uncertainty-screened")


def knowing_study():
    plain = small_study()
    bank = nbv.ShapeBank.of([pyramid_scene(Split.TRAIN, index, is_rotated=False) for index in range(5)])
    residual = ScreenedSPSR(GeometricSPSR(0.05, truncation=8), (OnSurface(),))
    model = KnownShapes(bank, residual, model_of_none=plain.sampler.model, num_starts=60)
    return dataclasses.replace(plain, sampler=dataclasses.replace(plain.sampler, model=model))


@pytest.fixture(scope="module")
def record():
    return run_scene(knowing_study(), SCENE, METHODS)


def choices(*methods):
    return [(method, view) for method in methods for view in (1, 2)]


# One method with known shapes and one without, since each compiles a planner.
FEW = [("cross-entropy", 2), ("uncertainty-screened", 2)]


@pytest.mark.parametrize(
    ("method", "view"),
    [one if one in FEW else pytest.param(*one, marks=pytest.mark.slow) for one in choices(*METHODS)],
)
def test_a_choice_is_that_of_the_planner_with_the_same_key(record, method, view):
    study = knowing_study()
    scene, poses = study.scene(SCENE), np.asarray(study.candidates.poses().position)
    planner, candidates = study.planner(method, scene), chosen(study, record["methods"][method])
    observations = observations_of(study, planner, scene, candidates[:view])
    proposed = planner.propose(observations, step_key(study, view)).pose.position
    np.testing.assert_allclose(poses[candidates[view]], proposed, atol=1e-5)


def test_methods_without_shapes_equal_those_of_a_study_without(record):
    plain = run_scene(small_study(), SCENE, ("coverage", "uncertainty"))
    for method in ("coverage", "uncertainty"):
        assert without_time(record["methods"][f"{method}-screened"]) == without_time(plain["methods"][method])


def test_the_models_of_studies_are_known_and_those_of_the_library():
    assert tuple(STUDY_MODELS) == (KNOWN, *MODELS)
    assert methods_of(PyramidStudy, None, "screened") == PyramidStudy.methods
    assert methods_of(PyramidStudy, None, KNOWN)[-2:] == ("coverage-screened", "uncertainty-screened")


# Known parts have their own bank.
OF_BANKS = [name for name, entry in studies().items() if entry.model == KNOWN and "parts" not in entry.options]


@pytest.mark.parametrize("name", OF_BANKS)
def test_a_study_whose_usual_model_is_known_has_a_bank(name):
    assert studies()[name].load().bank in SHIPPED_BANKS


def test_a_study_without_a_bank_refuses_to_know_shapes():
    with pytest.raises(nbv.InputError, match="no known shapes for"):
        type("Own", (HeatStudy,), {"bank": ""}).configured(KNOWN, 2, quick=True)


def test_parts_are_planned_with_the_shapes_of_their_category():
    (study,) = PartStudy.configured(KNOWN, 2, quick=True).values()
    scene = study.scene(2)
    names = study.planner("discrete", scene).sampler.model.bank.names
    assert {name.rsplit(" ", 1)[0] for name in names} == {scene.name}
    assert len(names) == 40


def test_each_mesh_is_planned_with_a_bank_of_the_others(tmp_path, monkeypatch):
    monkeypatch.setattr(mesh_shapes.platformdirs, "user_cache_path", lambda name: tmp_path / "cache")
    for index in range(3):
        trimesh.creation.box((1.0, 0.5 + 0.1 * index, 0.4)).export(tmp_path / f"box{index}.ply")
    (study,) = HeatStudy.configured(KNOWN, 2, quick=True, meshes=tmp_path).values()
    assert study.sampler.model.bank.names == ("box0 0", "box1 1", "box2 2")
    assert study.planner("coverage", study.scene(1)).sampler.model.bank.names == ("box0 0", "box2 2")
    (plain,) = HeatStudy.configured("paper", 2, quick=True, meshes=tmp_path).values()
    assert plain.sampler_of(plain.scene(1)) == plain.sampler


def test_a_planner_without_its_bank_equals_one_that_had_none():
    plain = nbv.SurfaceSampler.preset("screened", 1.25)
    with_bank = plain.with_bank(nbv.ShapeBank.of([nbv.sdf.Sphere(1.0)]), nbv.surfaces.AsGiven())
    assert with_bank.model.box == nbv.Box.cube(1.25)
    assert float(with_bank.model.residual.base.lengthscale) == pytest.approx(0.005)
    assert jax.tree.structure(with_bank.without_bank) == jax.tree.structure(plain)
    assert CAMERA.num_rays == 24 * 24
