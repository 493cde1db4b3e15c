"""The environment of Gymnasium: its contract, and rewards that add up to what was learned."""

import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import jaxnbv as nbv

CAMERA = nbv.Camera(height=9, width=12)
PLANNER = nbv.Planner(nbv.Coverage(), camera=CAMERA, imagination=nbv.Imagination(grid=nbv.Grid(20)), capacity=256)
POSES = nbv.SphereCandidates(14)


def ball(number):
    return nbv.sdf.Sphere(0.8 + 0.01 * (number % 5))


def height(cloud):
    """Of the points, from the lowest to the highest."""
    y = cloud.points[:, 1]
    return jnp.max(jnp.where(cloud.mask, y, -2.0)) - jnp.min(jnp.where(cloud.mask, y, 2.0))


def environment(actions=POSES, **changes):
    return nbv.ViewEnvironment(PLANNER, ball, height, actions, **({"views": 3} | changes))


@pytest.mark.parametrize("actions", [POSES, nbv.SpherePoses()], ids=["candidates", "poses"])
def test_gymnasium_finds_it_in_order(actions):
    check_env(environment(actions), skip_render_check=True)


def test_rewards_add_up_to_what_the_utility_rose_by():
    made = environment()
    _, told = made.reset(seed=3)
    total, before, truncated, steps = 0.0, told["utility"], False, 0
    while not truncated:
        seen, reward, terminated, truncated, told = made.step(steps)
        total, steps = total + reward, steps + 1
        assert not terminated
    assert steps == 2
    assert total == pytest.approx(told["utility"] - before)
    assert told["utility"] > 0.5
    np.testing.assert_allclose(seen["matrix"], POSES.poses()[1].matrix, atol=1e-6)
    assert seen["depth"].max() > 0


def test_the_depth_is_that_of_the_scene():
    quiet = environment(noise=nbv.SensorNoise(0.0, 0.0), scenes=1)
    seen, _ = quiet.reset(seed=0)
    hit = seen["depth"] > 0
    directions = np.asarray(CAMERA.pixel_directions()).reshape(9, 12, 3)
    points = (seen["depth"][..., None] * directions)[hit] @ seen["matrix"][:3, :3].T + seen["matrix"][:3, 3]
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), 0.8, atol=1e-4)


def test_an_action_moves_the_last_pose():
    made = environment(nbv.SpherePoses(2.4))
    before, _ = made.reset(seed=1)
    after, *_ = made.step(np.zeros(3, np.float32))
    np.testing.assert_allclose(after["matrix"], before["matrix"], atol=1e-5)
    turned, *_ = made.step(np.array([0.5, -0.2, 0.1], np.float32))
    assert np.linalg.norm(turned["matrix"][:3, 3]) == pytest.approx(2.4, abs=1e-4)
    assert np.abs(turned["matrix"] - before["matrix"]).max() > 0.1


def test_what_makes_no_sense_is_refused():
    with pytest.raises(nbv.InputError, match="1 views leaves nothing to decide"):
        environment(views=1)
    with pytest.raises(nbv.InputError, match="room for"):
        environment(views=1000)
    with pytest.raises(nbv.InputError, match="call reset first"):
        environment().step(0)
    made = environment()
    made.reset(seed=0)
    with pytest.raises(nbv.InputError, match="14 is no action"):
        made.step(14)
    with pytest.raises(nbv.InputError, match="the scene is 'a ball'"):
        nbv.ViewEnvironment(PLANNER, lambda number: "a ball", height, POSES).reset(seed=0)
