"""Training learns and stores its network; calibration recovers the temperature of a generator."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from training import calibrate, expected_calibration_error, log_probabilities, train

import jaxnbv as nbv

RNG = np.random.default_rng(0)


class Toy(eqx.Module):
    """A linear classifier of the mean of the points."""

    linear: eqx.nn.Linear
    temperature: jax.Array

    def __init__(self, temperature=1.0):
        self.linear = eqx.nn.Linear(3, 3, key=jax.random.key(0))
        self.temperature = jnp.asarray(temperature)

    def __call__(self, points, normals, mask):
        mean = jnp.sum(jnp.where(mask[:, None], points, 0.0), axis=0) / jnp.maximum(jnp.sum(mask), 1)
        return jax.nn.log_softmax(self.linear(mean) / self.temperature)


def toy_clouds(count):
    """Clouds around one of three corners, which is the class."""
    labels = np.arange(count) % 3
    points = (np.eye(3)[labels][:, None] + 0.3 * RNG.normal(size=(count, 6, 3))).astype(np.float32)
    return nbv.PointCloud(jnp.asarray(points), jnp.zeros_like(points), jnp.ones((count, 6), bool)), labels


def same(a, b):
    return all(np.array_equal(x, y) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True))


def test_training_learns_what_can_be_told_apart_and_is_read_from_its_file(tmp_path):
    data, file = toy_clouds(60), tmp_path / "toy.eqx"
    trained = train(Toy(), *data, jax.random.key(1), 150, batch_size=8, learning_rate=0.05, file=file)
    held_out, truth = toy_clouds(90)
    log_p = np.asarray(log_probabilities(trained, held_out))
    assert np.mean(log_p.argmax(axis=1) == truth) > 0.95
    assert -log_p[np.arange(90), truth].mean() < 0.3
    # The temperature is left to `calibrate`.
    assert float(trained.temperature) == 1.0
    assert same(train(Toy(), *data, jax.random.key(2), 1, file=file), trained)


def test_one_step_is_adamw_on_the_mean_loss_of_the_drawn_batch():
    """All rows of the data are equal, so that the batch is known. Adam's first step is the learning rate times the
    sign."""
    clouds, labels = toy_clouds(1)
    before, key = Toy(), jax.random.key(0)
    after = train(before, clouds, labels, key, 1, batch_size=4, learning_rate=0.01, weight_decay=0.1)
    p = np.exp(np.asarray(log_probabilities(before, clouds))[0])
    slope = np.outer(p - np.eye(3)[labels[0]], np.asarray(clouds.points[0]).mean(axis=0))
    expected = np.asarray(before.linear.weight) * (1 - 0.01 * 0.1) - 0.01 * np.sign(slope)
    np.testing.assert_allclose(after.linear.weight, expected, atol=1e-5)


@pytest.mark.parametrize(("factor", "start"), [(2.5, 1.0), (0.6, 1.0), (2.5, 0.5)])
def test_calibration_recovers_a_known_temperature(factor, start):
    """Labels are drawn from softmax(logits / factor). The likelihood's curvature gives the standard error."""
    count = 3000
    points = (2.0 * RNG.normal(size=(count, 1, 3))).astype(np.float32)
    clouds = nbv.PointCloud(jnp.asarray(points), jnp.zeros_like(points), jnp.ones((count, 1), bool))
    network = eqx.tree_at(lambda n: n.linear.weight, Toy(start), 2.0 * jnp.eye(3))
    logits = np.asarray(jax.vmap(network.linear)(clouds.points[:, 0]), np.float64) / factor
    p = np.exp(logits) / np.exp(logits).sum(axis=1, keepdims=True)
    labels = (RNG.random((count, 1)) > np.cumsum(p, axis=1)).sum(axis=1)
    calibrated = calibrate(network, clouds, labels)
    variance = (p * logits**2).sum(axis=1) - (p * logits).sum(axis=1) ** 2
    error = 1 / np.sqrt(variance.sum())
    assert error < 0.05
    assert np.log(float(calibrated.temperature) / factor) == pytest.approx(0.0, abs=4 * error)
    assert same(calibrated.linear, network.linear)
    before, after = (np.asarray(log_probabilities(n, clouds)) for n in (network, calibrated))
    assert expected_calibration_error(after, labels) < 0.03
    assert expected_calibration_error(before, labels) > 0.05


def test_calibration_error_of_a_hand_made_example():
    """Confidences 0.9 (right), 0.78 (wrong), 0.52 and 0.55 (both right). None of them is a border of a bin."""
    p = np.array([[0.9, 0.1], [0.22, 0.78], [0.52, 0.48], [0.45, 0.55]])
    labels = np.array([0, 0, 0, 1])
    for bins, expected in ((5, (0.1 + 0.78 + 0.48 + 0.45) / 4), (3, (0.48 + 0.45 + 1.68 - 1) / 4), (2, 0.25 / 4)):
        assert expected_calibration_error(np.log(p), labels, bins=bins) == pytest.approx(expected)
