"""The study of identification: placements of parts, measures, and a small run."""

import dataclasses
import json
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from PIL import Image

import jaxnbv as nbv
from jaxnbv.checks import InputError
from jaxnbv.geometry.pose_list import PoseList
from jaxnbv.scanning import barrier_of
from jaxnbv.studies.engine.pictures import write_pictures
from jaxnbv.studies.engine.results import results, summary, verdicts
from jaxnbv.studies.engine.run import run_scene
from jaxnbv.studies.identification import BY_NAME, IDENTIFY, IdentificationStudy
from jaxnbv.studies.scenes.framing import Setup
from jaxnbv.studies.scenes.placed_parts import parts_in
from jaxnbv.surfaces.part_hypotheses import NONE, PartHypotheses
from jaxnbv.surfaces.placement import Placement
from jaxnbv.surfaces.registration import Hypotheses

SMALL = {"num_candidates": 12, "num_samples": 2, "grid_resolution": 32, "capacity": 200}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Three parts in metres. Two of them have the same name."""
    folder = tmp_path_factory.mktemp("parts")
    block = trimesh.creation.box((0.10, 0.06, 0.04))
    block.export(folder / "block.ply")
    trimesh.util.concatenate([block, trimesh.creation.box((0.03, 0.03, 0.2))]).export(folder / "cross.ply")
    (folder / "spare").mkdir()
    trimesh.creation.cylinder(0.03, 0.12).export(folder / "spare" / "block.stl")
    return folder


class Keeping(IdentificationStudy):
    """The study, which keeps the steps of its last episode."""

    steps: ClassVar[list] = []

    def follow(self, scene, truth, planner, episode):
        self.steps[:] = episode
        return super().follow(scene, truth, planner, iter(self.steps))


def small_study(folder, setup=Setup.WHOLE, views=2):
    (study,) = Keeping.configured("known", views, True, parts=folder, setup=setup, **SMALL).values()
    return study


@pytest.fixture(scope="module")
def record(folder):
    return run_scene(small_study(folder, Setup.HIDDEN), 1, (IDENTIFY,))


def test_there_is_a_study_for_each_setup_and_none_without_known_parts(folder):
    studies = IdentificationStudy.configured("known", 3, False)
    assert list(studies) == ["whole", "close-up", "table", "hidden"]
    assert {study.meshes for study in studies.values()} == {()}
    assert small_study(folder).num_candidates == 12
    with pytest.raises(InputError, match="about known parts"):
        IdentificationStudy.configured("screened", 3, False)
    with pytest.raises(InputError, match="there is only one part, block: give a folder of at least two parts"):
        small_study(folder / "spare").scene(0)


def test_parts_are_at_true_size_and_names_differ(folder):
    parts = parts_in(small_study(folder).meshes)
    assert sorted(parts.bank.names) == ["block", "block 2", "cross"]
    for index, mesh in enumerate(parts.meshes):
        sides = np.ptp(mesh.vertices, axis=0)
        assert sides.max() == pytest.approx({"block": 0.1, "block 2": 0.12, "cross": 0.2}[parts.bank.names[index]])
        off = parts.bank.shape(jnp.asarray(index)).solid(jnp.asarray(mesh.vertices, jnp.float32))
        assert np.abs(np.asarray(off)).max() < 0.05 * sides.max()


def test_scenes_of_even_and_odd_numbers_share_no_part(folder):
    parts = parts_in(small_study(folder).meshes)
    even, odd = ({parts.choose(index) for index in range(start, 20, 2)} for start in (0, 1))
    assert even | odd == {0, 1, 2}
    assert not even & odd


@pytest.mark.parametrize("setup", Setup)
def test_a_part_lies_as_its_setup_says(folder, setup):
    study = small_study(folder, setup)
    poses = study.candidates.poses()
    for index in range(2):
        task = study.scene(index).task
        low, high = task.mesh.vertices.min(axis=0), task.mesh.vertices.max(axis=0)
        np.testing.assert_allclose(low, -high, atol=1e-6)
        assert (high - low).max() == pytest.approx(2.5)
        np.testing.assert_allclose(task.rotation @ task.rotation.T, np.eye(3), atol=1e-9)
        assert (task.obstacles is None) != setup.is_resting
        if task.obstacles is not None:
            distance = np.asarray(task.obstacles.distance(task.mesh.vertices.astype(np.float32)))
            assert -1e-5 < distance.min() < 1e-5
            # It stands on at least three points.
            assert (distance < 0.01).sum() >= 3
            assert (np.asarray(poses.position)[:, 1] > 0).all()


def test_a_box_hides_about_half_of_a_part_from_one_side(folder):
    study = small_study(folder, Setup.HIDDEN)
    for index in range(2):
        task = study.scene(index).task
        ring = [[5.0 * np.cos(angle), 0.0, 5.0 * np.sin(angle)] for angle in np.arange(4) * np.pi / 2]
        shares = []
        for pose in nbv.look_at(np.array(ring)):
            whole = nbv.scan(task.mesh, study.camera, pose)
            left = nbv.scan(task.mesh, study.camera, pose, barrier_of(task.obstacles, study.camera, pose))
            shares.append(int(left.count) / int(whole.count))
        assert 0.3 < min(shares) < 0.7
        assert sorted(shares)[-2] > 0.95


def test_a_scan_has_noisy_ranges_and_nothing_of_the_table(folder):
    study = small_study(folder, Setup.TABLE)
    scene = study.scene(0)
    pose = study.candidates.poses()[0]
    cloud = study.sensor(scene)(pose, jax.random.key(0))
    points, _ = cloud.to_numpy()
    assert len(points) > 50
    assert np.asarray(scene.task.obstacles.distance(points)).min() >= scene.task.obstacles.margin
    mask = np.asarray(cloud.mask)
    away = np.linalg.norm(np.asarray(cloud.points) - np.asarray(pose.position), axis=1)
    np.testing.assert_allclose(np.asarray(cloud.sight)[mask], away[mask], rtol=1e-6)


def test_methods_hold_the_same_bank_and_differ_in_their_views(folder):
    study = small_study(folder, Setup.TABLE)
    scene = study.scene(0)
    planners = {method: study.planner(method, scene) for method in (*study.methods, *study.extra_methods)}
    assert len({planner.sampler.model.bank.names for planner in planners.values()}) == 1
    assert all(planner.obstacles is scene.task.obstacles for planner in planners.values())
    assert planners[IDENTIFY].acquisition == nbv.Identify()
    assert planners[BY_NAME].acquisition == nbv.Identify(pose=False)
    assert isinstance(planners["new-surface"].acquisition, nbv.NewSurface)
    assert isinstance(planners["farthest"].search, nbv.FarthestView)


def hypotheses_of(task, part, turn=None, none=0.0):
    """All weight except that of "none of these" on a part in the true placement, turned in its own frame."""
    rotation = task.rotation if turn is None else task.rotation @ turn
    placement = Placement(*(jnp.asarray(row, jnp.float32)[None] for row in (rotation, task.shift, np.ones(3))))
    placed = Hypotheses(jnp.asarray([part]), placement, jnp.zeros(1), jnp.ones(1, bool))
    return PartHypotheses(task.bank, placed, jnp.asarray([1.0 - none, none]), *2 * [jnp.asarray(0.03)])


def test_the_measures_accept_only_the_truth_and_its_symmetries(folder):
    study = small_study(folder)
    index = next(index for index in range(6) if study.scene(index).name == "block")
    scene = study.scene(index)
    task, truth = scene.task, study.truth(scene)
    assert truth[2] == pytest.approx(task.scale * np.linalg.norm([0.10, 0.06, 0.04]), rel=1e-4)
    half_turn, quarter_turn = np.diag([-1.0, -1.0, 1.0]), np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0, 0, 1.0]])
    for turn in (None, half_turn):
        measures = study._view_record(truth, hypotheses_of(task, task.part, turn))
        assert measures["named"] == "block"
        assert measures["right"] == measures["placed"] == 1
        assert measures["p_true"] == 1.0
        assert measures["fit"] < 0.005
        assert measures["add_s"] < 0.01
    measures = study._view_record(truth, hypotheses_of(task, task.part, quarter_turn))
    assert (measures["right"], measures["placed"]) == (1, 0)
    assert measures["fit"] > 0.03
    assert measures["add_s"] > 0.03
    other = next(part for part, name in enumerate(task.bank.names) if name == "cross")
    measures = study._view_record(truth, hypotheses_of(task, other))
    assert (measures["named"], measures["right"], measures["placed"], measures["p_true"]) == ("cross", 0, 0, 0)
    measures = study._view_record(truth, hypotheses_of(task, task.part, none=0.6))
    assert (measures["named"], measures["right"]) == (NONE, 0)
    assert measures["p_true"] == pytest.approx(0.4)


def test_tied_names_share_the_right_answer(folder):
    study = small_study(folder)
    scene = study.scene(0)
    task, truth = scene.task, study.truth(scene)
    alone = hypotheses_of(task, task.part)
    both = jax.tree.map(lambda row: jnp.concatenate([row, row]), alone.placed)
    both = dataclasses.replace(both, shape=jnp.asarray([(task.part + 1) % 3, task.part]))
    for weights, right in (([0.45, 0.45], 0.5), ([0.4, 0.5], 1.0), ([0.5, 0.4], 0.0)):
        hypotheses = PartHypotheses(task.bank, both, jnp.asarray([*weights, 0.1]), *2 * [jnp.asarray(0.03)])
        measures = study._view_record(truth, hypotheses)
        assert measures["right"] == right


def test_a_record_is_json_and_holds_what_is_measured(record):
    assert json.loads(json.dumps(record, allow_nan=False)) == record
    assert (record["scene"], record["setup"], record["set"]) == (1, "hidden", "")
    for measure in IdentificationStudy.measures:
        values = measure.compute(record, IDENTIFY)
        if measure.key_name == "view":
            assert len(values) == 2
            # A sum of weights may be larger than one by rounding.
            assert all(0 <= value <= 1 + 1e-6 for value in values)
    run = record["methods"][IDENTIFY]
    assert all(name == record["name"] for name, right in zip(run["named"], run["right"], strict=True) if right == 1)
    assert all(placed <= right for placed, right in zip(run["placed"], run["right"], strict=True))
    # Three parts as different as these are identified.
    assert run["right"][-1] == 1


def test_the_choice_is_that_of_the_planner_with_the_same_key(record, folder):
    """All studies have this loop (`test_a_study_takes_the_views_of_a_simulation`). Here it carries hypotheses."""
    study, run = small_study(folder, Setup.HIDDEN), record["methods"][IDENTIFY]
    key = jax.random.split(jax.random.fold_in(study.key(1, "episode"), 1))[0]
    planner = study.planner(IDENTIFY, study.scene(1))
    proposal = planner.propose(Keeping.steps[0].observations, key, PoseList.empty(planner.max_views))
    np.testing.assert_allclose(proposal.pose.position, run["views"][1]["position"], atol=1e-5)


def test_tables_claims_and_pictures_are_made_of_a_record(record, folder, tmp_path):
    both = record | {"methods": {IDENTIFY: record["methods"][IDENTIFY], "random": record["methods"][IDENTIFY]}}
    table = results([both], IdentificationStudy)
    text = summary(table, IdentificationStudy)
    for measure in IdentificationStudy.measures[:-1]:
        assert measure.title in text
    (verdict,) = verdicts(table, IdentificationStudy)
    assert verdict.num_methods == 1
    (picture,) = write_pictures([record], small_study(folder, Setup.HIDDEN), tmp_path, pixels=80)
    image = np.asarray(Image.open(picture).convert("L"))
    # The truth and two views.
    for strip in np.array_split(image[:, 100:-100], 3, axis=1):
        assert strip.std() > 5
