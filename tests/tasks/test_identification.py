"""Information about the identity of a part, from informative and uninformative views."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxnbv as nbv
from jaxnbv.observations import Observations
from jaxnbv.planning.stopping import StopContext
from jaxnbv.sampler import StepInputs
from jaxnbv.scanning.sdf import Cuboid, Translated, Union
from jaxnbv.surfaces.part_hypotheses import PartHypotheses
from jaxnbv.surfaces.placement import Placement
from jaxnbv.surfaces.registration import Hypotheses
from jaxnbv.tasks.identification import entropy_of_weights

CAMERA = nbv.Camera(height=24, width=24, fov=1.0)
GRID = nbv.Grid(48)


def block(height, side):
    """A block with a boss on top, at either side."""
    boss = Translated(Cuboid(np.array([0.25, height, 0.25])), np.array([side, 0.4 + height, 0.0]))
    return Union(Cuboid(np.array([1.0, 0.4, 0.8])), boss)


BANK = nbv.ShapeBank.of(
    [block(0.05, 0.4), block(0.3, 0.4), block(0.05, -0.4)], ["low", "high", "other"], is_true_size=True
)
TAU = jnp.asarray(0.03)
ABOVE, BELOW = (0.3, 3.2, 0.4), (0.0, -3.2, 0.3)


def step(weights, shapes=(0, 1, 2), turns=None):
    count = len(shapes)
    turns = np.tile(np.eye(3), (count, 1, 1)) if turns is None else turns
    placement = Placement(jnp.asarray(turns, jnp.float32), jnp.zeros((count, 3)), jnp.ones((count, 3)))
    placed = Hypotheses(jnp.asarray(shapes), placement, jnp.zeros(count), jnp.ones(count, bool))
    cloud = nbv.PointCloud(jnp.zeros((4, 3)), jnp.ones((4, 3)), jnp.ones(4, bool))
    hypotheses = PartHypotheses(BANK, placed, jnp.asarray([*weights, 0.0]), TAU, TAU)
    observations = Observations.start(cloud, 2, GRID, camera=CAMERA)
    observations = Observations(
        *(getattr(observations, name) for name in ("cloud", "poses", "grid", "looks", "empty_nodes", "obstacle_nodes")),
        hypotheses,
    )
    return StepInputs(observations, None, hypotheses.surfaces(GRID, count))


@jax.jit
def scores_and_slopes(context, eyes):
    def total(eyes):
        scores = nbv.Identify().sample_scores(context, context.surfaces, CAMERA, jax.vmap(nbv.look_at)(eyes))[0]
        return jnp.sum(scores), scores

    slopes, scores = jax.grad(total, has_aux=True)(eyes)
    return scores, slopes


def information(acquisition, weights, eyes=(ABOVE, BELOW), **changed):
    """Information at two poses, and its derivatives in the camera's positions. Empty classes keep the program."""
    context = acquisition.context(step(weights, **changed))
    classes = jnp.pad(context.classes, ((0, 0), (0, len(BANK) - context.classes.shape[1])))
    return scores_and_slopes(eqx.tree_at(lambda c: c.classes, context, classes), jnp.array(eyes))


def test_a_view_is_worth_what_it_tells():
    """From below the blocks are equal. From above a view tells them apart, which is worth the whole entropy in nats."""
    above, below = information(nbv.Identify(), (0.5, 0.5, 0.0))[0]
    assert above == pytest.approx(np.log(2.0), rel=0.02)
    assert below == pytest.approx(0.0, abs=1e-3)
    above, below = information(nbv.Identify(), (0.25, 0.25, 0.5))[0]
    assert above == pytest.approx(1.5 * np.log(2.0), rel=0.02)
    assert below == pytest.approx(0.0, abs=1e-3)


def test_names_poses_and_groups():
    """A block that may be turned end for end is the other block for its name, but not for its pose."""
    half_turn = np.array([np.eye(3), np.diag([-1.0, 1.0, -1.0]), np.eye(3)])
    weights, shapes = (0.4, 0.4, 0.2), (0, 0, 1)
    by_pose, by_name, by_group = (
        information(acquisition, weights, shapes=shapes, turns=half_turn)[0][0]
        for acquisition in (
            nbv.Identify(),
            nbv.Identify(pose=False),
            nbv.Identify(group=["block", "block", "other"]),
        )
    )
    names = float(entropy_of_weights(jnp.array([0.8, 0.2])))
    # Information about the pose beyond the name counts a tenth.
    assert by_pose == pytest.approx(names + 0.1 * (float(entropy_of_weights(jnp.array(weights))) - names), rel=0.02)
    assert by_name == pytest.approx(names, rel=0.02)
    assert by_group == pytest.approx(0.0, abs=1e-3)


def test_derivative_in_the_pose():
    """Information changes smoothly where a boss comes into sight."""
    eyes = [[3.2 * np.sin(angle), 3.2 * np.cos(angle), 0.32] for angle in (1.2, 1.1)]
    slopes = np.asarray(information(nbv.Identify(), (0.5, 0.5, 0.0), eyes)[1])
    assert np.isfinite(slopes).all()
    assert (np.linalg.norm(slopes, axis=1) > 0).all()


def test_its_requirements():
    with pytest.raises(nbv.InputError, match="the group is the text 'abc': give a list"):
        nbv.Identify(group="abc")
    with pytest.raises(nbv.InputError, match="needs known parts"):
        nbv.Planner(nbv.Identify())
    with pytest.raises(nbv.InputError, match="2 names for 3 parts"):
        information(nbv.Identify(group=["a", "b"]), (0.5, 0.5, 0.0))
    with pytest.raises(nbv.InputError, match="no hypotheses"):
        nbv.Identify().context(StepInputs(Observations.start(step((1.0, 0.0, 0.0)).observations.cloud)))


def test_rules_stop_once_the_part_or_its_surface_is_known(monkeypatch):
    """Both rules read the observations and the frame only. The error of the surface is in scene units."""
    monkeypatch.setattr("jaxnbv.planning.part_rules.surface_error", lambda hypotheses, observations: 0.4)
    for weights, name in (((0.93, 0.07, 0.0), "low"), ((0.07, 0.93, 0.0), "high")):
        observations = step(weights).observations
        context = StopContext(
            nbv.Planner.for_parts(BANK), observations, (), 0.0, jax.random.key(0), dict, nbv.Frame(scale=10.0)
        )
        assert nbv.Identified(0.9).after(context) == f"it is {name} (93 %)"
        assert nbv.Identified(0.95).after(context) is None
        assert nbv.Placed(0.039).after(context) is None
        assert nbv.Placed(0.041).after(context) == "its surface is known to 0.04"


@pytest.mark.slow
def test_an_episode_ends_once_the_part_is_known():
    """The planner, its proposal and the stop rules in a simulation."""
    planner = nbv.Planner.for_parts(BANK)
    scene, first = nbv.SDFSurface(block(0.3, 0.4)), nbv.look_at(BELOW)
    until = nbv.Identified(0.9) | nbv.Placed(0.001)
    episode = nbv.simulate(
        planner, scene, first, 3, jax.random.key(0), nbv.SensorNoise(0.005, 0.005), progress=False, until=until
    )
    assert episode.stop_reason is not None
    assert "high" in episode.stop_reason
    assert len(episode.views) <= 3
    assert float(episode.views[1].proposal.value) > 0.2
