"""A completer as an imagination: believed where the scan does not contradict it, and asked once a key."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxnbv as nbv
from jaxnbv.surfaces import KnownShapesPosterior

BALL = np.asarray(nbv.fibonacci_sphere(4096), np.float64)
CUBE = np.random.default_rng(0).uniform(-1.2, 1.2, (6000, 3))
CUBE[np.arange(6000), np.arange(6000) % 3] = np.where(np.arange(6000) % 2, 1.2, -1.2)
CAMERA = nbv.Camera(height=24, width=24)
FIRST = nbv.look_at((0.0, 0.0, 2.5))
SCAN = nbv.scan(nbv.SDFSurface(nbv.sdf.Sphere(1.0)), CAMERA, FIRST)
PLAIN = nbv.ScreenedSPSR(nbv.GeometricSPSR(0.02, truncation=12))


def the_ball(cloud, key):
    return BALL


def the_cube(cloud, key):
    return CUBE


def of_radius(radius):
    """Places behind the ball, which the scan has not seen."""
    behind = BALL[BALL[:, 2] < -0.7][::20]
    return jnp.asarray(radius * behind, jnp.float32)


def test_the_side_that_was_not_seen_is_as_it_is_completed():
    posterior = nbv.Completed(PLAIN, the_ball).condition(SCAN)
    drawn = posterior.drawn(16)
    inside, outside = (np.asarray(drawn.probability_inside(of_radius(radius))) for radius in (0.9, 1.1))
    assert inside.mean() > 0.95
    assert outside.mean() < 0.05
    # The model alone does not know where the ball ends.
    alone = PLAIN.condition(SCAN)
    told = [np.asarray(alone.probability_inside(of_radius(radius))).mean() for radius in (0.9, 1.1)]
    assert told[0] - told[1] < 0.5
    first, *_ = posterior.hypotheses
    assert first.name == "completion 1"
    assert first.weight > 0.9


def test_a_completion_that_the_scan_contradicts_has_no_weight():
    posterior = nbv.Completed(PLAIN, the_cube).condition(SCAN)
    first, second = posterior.hypotheses
    assert (first.name, second.name) == ("none of these", "completion 1")
    assert first.weight > 0.95


def test_it_is_asked_under_as_many_keys_and_the_best_are_believed_most():
    asked = []

    def completer(cloud, key):
        asked.append(jax.random.key_data(key).tolist())
        return BALL * (1.0, 1.3, 1.6)[len(asked) % 3 - 1]

    model = nbv.Completed(PLAIN, completer, num_completions=3)
    posterior = model.condition(SCAN)
    assert len({tuple(key) for key in asked}) == 3
    weights = {one.name: one.weight for one in posterior.hypotheses}
    assert weights["completion 1"] > weights["completion 2"] > weights["completion 3"]
    again = model.condition(SCAN)
    assert asked[3:] == asked[:3]
    np.testing.assert_array_equal(posterior.weights, again.weights)
    assert sum(posterior.kinds().values()) == pytest.approx(1.0, abs=1e-5)


@pytest.mark.slow
def test_a_planner_takes_it_and_compiles_once(compilations):
    imagination = nbv.Imagination(nbv.Completed(PLAIN, the_ball), nbv.Grid(24), 2)
    planner = nbv.Planner(nbv.NewSurface(), nbv.DiscreteSearch(8), CAMERA, imagination, capacity=256)
    evidence = planner.init(FIRST, SCAN)
    proposal = planner.propose(evidence, jax.random.key(0))
    there = nbv.scan(nbv.SDFSurface(nbv.sdf.Sphere(1.0)), CAMERA, proposal.pose)
    evidence = planner.observe(evidence, proposal.pose, there)
    planner.propose(evidence, jax.random.key(1))
    compilations.clear()
    planner.propose(evidence, jax.random.key(2))
    assert not compilations
    assert isinstance(planner.imagination.posterior(evidence), KnownShapesPosterior)
    # It looks at what was not seen.
    assert float(proposal.pose.position[2]) < 1.5


@pytest.mark.parametrize(
    ("answer", "word"),
    [
        (BALL[:, :2], "4096, 2"),
        ("points", "points"),
        (np.full((9, 3), np.nan), "finite"),
        (np.ones((9, 3)), "1 different points"),
    ],
)
def test_what_is_no_surface_is_refused(answer, word):
    with pytest.raises(nbv.InputError, match=word) as refused:
        nbv.Completed(PLAIN, lambda cloud, key: answer).condition(SCAN)
    assert "completer" in str(refused.value)
