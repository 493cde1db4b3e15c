"""The best candidates of a proposal that look from different directions."""

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import jaxnbv as nbv
from jaxnbv.checks import InputError

# Beside the origin, so that directions are not those of the cameras' axes.
POSES = nbv.look_at(
    np.asarray(nbv.geometry.fibonacci_sphere(40, 2.5)) * np.linspace(0.8, 1.2, 40)[:, None], [0.2, 0, 0]
)


def proposal_of(values):
    return nbv.search.Proposal(POSES[0], jnp.asarray(values[0]), POSES, jnp.asarray(values))


def angle(one, other):
    return np.degrees(np.arctan2(np.linalg.norm(np.cross(one, other)), one @ other))


@settings(max_examples=25)
@given(seed=st.integers(0, 1000), count=st.integers(1, 8), min_angle=st.floats(5.0, 120.0), excluded=st.integers(0, 39))
def test_each_of_the_best_is_the_best_that_is_far_from_those_before_it(seed, count, min_angle, excluded):
    rng = np.random.default_rng(seed)
    values = rng.permutation(40).astype(np.float32)
    values[rng.permutation(40)[:excluded]] = -np.inf
    positions, best = np.asarray(POSES.position, np.float64), proposal_of(values).best(count, min_angle)
    chosen = [int(np.linalg.norm(positions - place, axis=1).argmin()) for place in np.asarray(best.position)]
    for number in range(len(chosen) + 1):
        before = chosen[:number]
        free = [
            index
            for index in np.flatnonzero(values > -np.inf)
            if all(angle(positions[index], positions[other]) >= min_angle for other in before)
        ]
        if number < len(chosen):
            assert chosen[number] == max(free, key=lambda index: values[index])
        else:
            assert len(chosen) == count or not free


def test_a_count_or_an_angle_that_cannot_be_is_refused():
    proposal = proposal_of(np.arange(40.0, dtype=np.float32))
    for arguments, problem in (
        ((0,), "the count is 0"),
        ((3, -1.0), "min_angle is -1.0"),
        ((3, 200.0), "min_angle is 200.0"),
    ):
        with pytest.raises(InputError, match=problem):
            proposal.best(*arguments)
