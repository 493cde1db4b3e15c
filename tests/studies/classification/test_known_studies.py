"""Studies with known shapes, compared with methods without them."""

import jax
import numpy as np
import pytest
import trimesh

import jaxnbv as nbv
from jaxnbv.cli.registry import STUDY_MODELS
from jaxnbv.sampler import MODELS
from jaxnbv.storage import describe
from jaxnbv.studies.classification.objects import HouseholdStudy, PyramidStudy
from jaxnbv.studies.engine.measures import KNOWN
from jaxnbv.studies.engine.run import methods_of
from jaxnbv.studies.heat import HeatStudy
from jaxnbv.studies.parts.study import PartStudy
from jaxnbv.studies.registry import studies
from jaxnbv.surfaces import KnownShapes, mesh_shapes
from jaxnbv.surfaces.shipped_banks import SHIPPED_BANKS


def configured(study, model, **settings):
    return next(iter(study.configured(model, 2, quick=True, **settings).values()))


def test_methods_without_shapes_have_the_planners_of_a_study_without():
    known, plain = (configured(HeatStudy, model) for model in (KNOWN, "screened"))
    scene = known.scene(0)
    for method in ("coverage", "uncertainty"):
        assert isinstance(known.planner(method, scene).sampler.model, KnownShapes)
        assert describe(known.planner(f"{method}-screened", scene)) == describe(plain.planner(method, scene))


def test_the_models_of_studies_are_known_and_those_of_the_library():
    assert tuple(STUDY_MODELS) == (KNOWN, *MODELS)
    assert methods_of(PyramidStudy, None, "screened") == PyramidStudy.methods
    assert methods_of(PyramidStudy, None, KNOWN)[-2:] == ("coverage-screened", "uncertainty-screened")


def test_studies_whose_usual_model_is_known_have_a_bank_and_others_refuse_to_know_shapes():
    # Known parts have their own bank.
    names = [name for name, entry in studies().items() if entry.model == KNOWN and "parts" not in entry.options]
    assert len(names) > 2
    assert {studies()[name].load().bank for name in names} <= {*SHIPPED_BANKS}
    with pytest.raises(nbv.InputError, match="no known shapes for"):
        configured(type("Own", (HeatStudy,), {"bank": ""}), KNOWN)


def test_parts_are_planned_with_the_shapes_of_their_category():
    study = configured(PartStudy, KNOWN)
    scene = study.scene(2)
    names = study.planner("discrete", scene).sampler.model.bank.names
    assert {name.rsplit(" ", 1)[0] for name in names} == {scene.name}
    assert len(names) == 40


def test_each_mesh_is_planned_with_a_bank_of_the_others(tmp_path, monkeypatch):
    monkeypatch.setattr(mesh_shapes.platformdirs, "user_cache_path", lambda name: tmp_path / "cache")
    for index in range(3):
        trimesh.creation.box((1.0, 0.5 + 0.1 * index, 0.4)).export(tmp_path / f"box{index}.ply")
    study = configured(HeatStudy, KNOWN, meshes=tmp_path)
    assert study.sampler.model.bank.names == ("box0 0", "box1 1", "box2 2")
    assert study.planner("coverage", study.scene(1)).sampler.model.bank.names == ("box0 0", "box2 2")
    plain = configured(HeatStudy, "paper", meshes=tmp_path)
    assert plain.sampler_of(plain.scene(1)) == plain.sampler


def test_classes_of_meshes_are_planned_with_the_whole_shipped_bank(tmp_path):
    (tmp_path / "bathtub").mkdir()
    trimesh.creation.box((1.0, 0.5, 0.4)).export(tmp_path / "bathtub" / "bathtub.ply")
    study = configured(HouseholdStudy, KNOWN, meshes=tmp_path)
    # Mesh name and scene index together are the name of a shape of the bank.
    assert "bathtub 0" in study.planner("cross-entropy", study.scene(0)).sampler.model.bank.names


def test_a_planner_without_its_bank_equals_one_that_had_none():
    plain = nbv.SurfaceSampler.preset("screened", 1.25)
    with_bank = plain.with_bank(nbv.ShapeBank.of([nbv.sdf.Sphere(1.0)]), nbv.surfaces.AsGiven())
    assert with_bank.model.box == nbv.Box.cube(1.25)
    assert float(with_bank.model.residual.base.lengthscale) == pytest.approx(0.005)
    without = with_bank.without_bank
    assert jax.tree.structure(without) == jax.tree.structure(plain)
    for a, b in zip(jax.tree.leaves(without), jax.tree.leaves(plain), strict=True):
        np.testing.assert_array_equal(a, b)
