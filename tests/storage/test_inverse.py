"""Loaded episodes, sessions and studies equal the saved ones."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_session import FIRST, session_of, shot

import jaxnbv as nbv
from jaxnbv.planning.loop import View
from jaxnbv.storage import describe
from jaxnbv.studies.engine.records import RecordFolder
from jaxnbv.studies.engine.run import load_study
from jaxnbv.studies.heat import HeatStudy
from jaxnbv.surfaces import KnownShapes, Upright

SPHERE = np.asarray(nbv.geometry.fibonacci_sphere(64))
BANK = nbv.ShapeBank.of([nbv.sdf.Sphere(0.9), nbv.sdf.Sphere(0.7)])


def height(cloud):
    return jnp.max(jnp.where(cloud.mask, cloud.points[:, 1], 0.0))


def halves(cloud):
    return jnp.log(jnp.array([0.5, 0.5])) + 0.0 * cloud.points.sum()


CAMERA = nbv.Camera(height=8, width=8, farthest=9.0)
FINE = nbv.SurfaceSampler(grid=nbv.Grid(30, 1.6), carving=nbv.Carving(nbv.Box.cube(2.9)))
TABLE = nbv.Obstacles((nbv.sdf.HalfSpace([0, -1.2, 0], [0, 1, 0]),), margin=0.01)
SMALL = {"capacity": 40, "max_views": 3}
PLANNERS = (
    (nbv.Coverage(), nbv.FarthestView(9), nbv.SurfaceSampler.preset("paper"), {"obstacles": TABLE, "capacity": 64}),
    (nbv.ExpectedUtilityImprovement(height, 32), nbv.HalvingSearch(8), FINE, SMALL),
    (nbv.CrossEntropy(halves), nbv.RandomView(nbv.Reach(7)), nbv.SurfaceSampler().with_bank(BANK, Upright()), SMALL),
)


def scan_of(shift):
    """A cloud of the image's size. Some rays have no return."""
    there = SPHERE[:, 2] > shift
    rows = [jnp.asarray(np.where(there[:, None], part, 0.0), jnp.float32) for part in (0.9 * SPHERE, SPHERE)]
    return nbv.PointCloud(*rows, jnp.asarray(there), jnp.asarray(~there))


def assert_same(loaded, saved):
    assert eqx.tree_equal(loaded, saved), f"{loaded} is not {saved}"


def episode_of(planner, frame=nbv.Frame(), stop_reason=None):  # noqa: B008
    """Three views without computing any proposal."""
    candidates = nbv.SphereCandidates(5).poses()
    poses, scans = [candidates[index] for index in range(3)], [scan_of(shift) for shift in (-0.5, 0.0, 0.5)]
    values = jnp.arange(5.0)
    proposal = nbv.search.Proposal(candidates[1], values[1], candidates, values, standard_error=jnp.asarray(0.5))
    episode = nbv.Episode(planner, None, nbv.SensorNoise(0.02), poses[0], jax.random.key(7), frame=frame)
    views = [
        View(pose, scan, after.cloud, None if index == 0 else proposal, planner.camera)
        for index, (pose, scan, after) in enumerate(
            zip(poses, scans, planner.replay(zip(poses, scans, strict=True)), strict=True)
        )
    ]
    return dataclasses.replace(episode, views=tuple(views), stop_reason=stop_reason)


@pytest.mark.parametrize("index", range(3))
def test_an_episode_is_loaded_as_it_was_saved(tmp_path, index):
    acquisition, search, sampler, options = PLANNERS[index]
    planner = nbv.Planner(acquisition, search, CAMERA, sampler, **options)
    frame = nbv.Frame(3.0, (1.0, 2.0, 3.0), "z") if index else nbv.Frame()
    episode = episode_of(planner, frame, "enough" if index == 1 else None)
    episode.save(tmp_path)
    loaded = nbv.Episode.load(tmp_path)
    assert_same(loaded, episode)
    # It can be saved again. A further view changes the stop reason.
    loaded.save(tmp_path)


def test_a_part_that_cannot_be_rebuilt_is_passed_to_load(tmp_path):
    """A utility without a name. The folder recognises it, but cannot make it again."""
    planner, other = (
        nbv.Planner(lambda cloud, number=number: cloud.count * number, nbv.FarthestView(9), CAMERA, FINE, **SMALL)
        for number in (1.0, 2.0)
    )
    episode = episode_of(planner)
    episode.save(tmp_path)
    with pytest.raises(nbv.InputError, match=r"planner\.acquisition.*load\(\.\.\., planner=\.\.\.\)"):
        nbv.Episode.load(tmp_path)
    assert_same(nbv.Episode.load(tmp_path, planner=planner), episode)
    with pytest.raises(nbv.InputError, match="belongs to another episode"):
        nbv.Episode.load(tmp_path, planner=other)


def test_a_session_and_its_episode_are_loaded_as_they_were_saved(tmp_path):
    session = session_of(tmp_path / "session")
    session.add(shot(FIRST), FIRST, depth_scale=1e-3)
    loaded = nbv.Session.load(tmp_path / "session", progress=False)
    assert_same(loaded.episode, session.episode)
    session.episode.save(tmp_path / "episode")
    assert_same(nbv.Episode.load(tmp_path / "episode"), session.episode)


def test_a_study_is_loaded_as_it_was_run(tmp_path):
    (study,) = HeatStudy.configured("screened", 3, True).values()
    study = dataclasses.replace(study, sampler=study.sampler.with_bank(BANK, Upright()))
    arrays = {}
    folder = RecordFolder(tmp_path, {"study": describe(study, arrays, "study"), "methods": []}, arrays=arrays)
    records = folder.collect(range(2), lambda index: {"scene": index, "methods": {}}, progress=False)
    loaded, read = load_study(tmp_path)
    assert isinstance(loaded.sampler.model, KnownShapes)
    assert_same(loaded, study)
    assert read == records
