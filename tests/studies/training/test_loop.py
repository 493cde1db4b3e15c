"""Training that is interrupted goes on as if it had not been; calibration finds what a generator hid."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnbv.checks import InputError
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.studies.training import calibrate, expected_calibration_error, log_probabilities, loop, train

RNG = np.random.default_rng(0)


class Toy(eqx.Module):
    """A linear classifier of the mean of the points."""

    linear: eqx.nn.Linear
    temperature: jax.Array

    def __init__(self, classes=3, temperature=1.0):
        self.linear = eqx.nn.Linear(3, classes, key=jax.random.key(0))
        self.temperature = jnp.asarray(temperature)

    def __call__(self, points, normals, mask):
        mean = jnp.sum(jnp.where(mask[:, None], points, 0.0), axis=0) / jnp.maximum(jnp.sum(mask), 1)
        return jax.nn.log_softmax(self.linear(mean) / self.temperature)


class Plain(eqx.Module):
    weight: jax.Array

    def __call__(self, points, normals, mask):
        return jax.nn.log_softmax(self.weight @ jnp.mean(points, axis=0))


def toy_clouds(count):
    """Clouds about one of three corners; which one is the class."""
    labels = np.arange(count) % 3
    points = (np.eye(3)[labels][:, None] + 0.3 * RNG.normal(size=(count, 6, 3))).astype(np.float32)
    return PointCloud(jnp.asarray(points), jnp.zeros_like(points), jnp.ones((count, 6), bool)), labels


def loss(network, clouds, labels):
    return -float(np.mean(np.asarray(log_probabilities(network, clouds))[np.arange(len(labels)), labels]))


def run(clouds, labels, steps=40, folder=None, batch_size=8, seed=1, **settings):
    settings = {"learning_rate": 0.05, "progress": False} | settings
    return train(Toy(), clouds, labels, jax.random.key(seed), steps, batch_size, folder=folder, **settings)


def same(a, b):
    return all(np.array_equal(x, y) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True))


def test_training_learns_what_can_be_told_apart_and_leaves_the_temperature():
    clouds, labels = toy_clouds(60)
    trained = run(clouds, labels, steps=150)
    assert loss(Toy(), clouds, labels) > 0.8
    assert loss(trained, clouds, labels) < 0.3
    held_out, truth = toy_clouds(90)
    assert np.mean(np.asarray(log_probabilities(trained, held_out)).argmax(axis=1) == truth) > 0.95
    assert float(trained.temperature) == 1.0
    assert same(trained, run(clouds, labels, steps=150))
    assert not same(trained, run(clouds, labels, steps=150, seed=2))


def test_one_step_is_adamw_on_the_mean_loss_of_the_drawn_batch():
    """With every row of the data the same the batch is known; Adam's first step is the learning rate by sign."""
    clouds, labels = toy_clouds(1)
    found = train(Toy(), clouds, labels, jax.random.key(0), 1, 4, 0.01, weight_decay=0.1, progress=False)
    before = Toy()
    p = np.exp(np.asarray(log_probabilities(before, clouds))[0])
    slope = np.outer(p - np.eye(3)[labels[0]], np.asarray(clouds.points[0]).mean(axis=0))
    expected = np.asarray(before.linear.weight) * (1 - 0.01 * 0.1) - 0.01 * np.sign(slope)
    np.testing.assert_allclose(found.linear.weight, expected, atol=1e-5)


def test_a_network_without_a_temperature_is_trained_too():
    clouds, labels = toy_clouds(30)
    start = Plain(jnp.zeros((3, 3)))
    trained = train(start, clouds, labels, jax.random.key(0), 80, 8, 0.05, progress=False)
    assert loss(trained, clouds, labels) < 0.5 * loss(start, clouds, labels)
    with pytest.raises(InputError, match="no temperature to calibrate"):
        calibrate(trained, clouds, labels)


def test_an_interrupted_training_continues_as_if_it_had_not_been(tmp_path, monkeypatch):
    clouds, labels = toy_clouds(40)
    whole = run(clouds, labels)
    monkeypatch.setattr(loop, "_STEPS_A_CHECKPOINT", 7)
    write, written = loop._Checkpoint.write, []

    def write_then_stop(self, step, carry):
        write(self, step, carry)
        written.append(step)
        if step in (14, 28):
            raise KeyboardInterrupt

    monkeypatch.setattr(loop._Checkpoint, "write", write_then_stop)
    for _ in range(2):
        with pytest.raises(KeyboardInterrupt):
            run(clouds, labels, folder=tmp_path)
    assert same(run(clouds, labels, folder=tmp_path), whole)
    assert written == [7, 14, 21, 28, 35, 40]
    # Complete: read, not trained again.
    assert same(run(clouds, labels, folder=tmp_path), whole)
    assert written == [7, 14, 21, 28, 35, 40]


def test_checkpoints_of_another_training_and_damaged_ones_are_refused(tmp_path):
    clouds, labels = toy_clouds(40)
    run(clouds, labels, folder=tmp_path)
    for other in ({"steps": 41}, {"batch_size": 10}, {"learning_rate": 0.04}, {"weight_decay": 0.5}):
        with pytest.raises(InputError, match="belongs to another training"):
            run(clouds, labels, folder=tmp_path, **other)
    with pytest.raises(InputError, match="belongs to another training"):
        run(*toy_clouds(42), folder=tmp_path)
    with pytest.raises(InputError, match="another"):
        train(Toy(4), clouds, labels, jax.random.key(1), 40, 8, 0.05, folder=tmp_path, progress=False)
    file = tmp_path / "training.npz"
    whole = file.read_bytes()
    for damaged in (whole[: len(whole) // 2], b"", b"nothing of the kind", whole[:300] + b"\0" * 50 + whole[350:]):
        file.write_bytes(damaged)
        with pytest.raises(InputError, match="damaged"):
            run(clouds, labels, folder=tmp_path)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"steps": 0}, "steps=0"),
        ({"batch_size": 7}, "multiple of 2"),
        ({"batch_size": 0}, "batch_size=0"),
        ({"learning_rate": 0.0}, r"learning_rate=0\.0"),
    ],
)
def test_settings_that_cannot_be_used_are_refused(settings, message):
    with pytest.raises(InputError, match=message):
        run(*toy_clouds(6), **settings)


def test_no_clouds_or_too_few_labels_are_refused():
    clouds, labels = toy_clouds(6)
    for some, given in ((clouds, labels[:5]), (clouds[:0], labels[:0])):
        with pytest.raises(InputError, match="give one label a cloud"):
            run(some, given)
        with pytest.raises(InputError, match="give one label a cloud"):
            calibrate(Toy(), some, given)
    with pytest.raises(InputError, match="no clouds"):
        expected_calibration_error(np.zeros((0, 3)), np.zeros(0, int))


@pytest.mark.parametrize(("factor", "start"), [(2.5, 1.0), (0.6, 1.0), (2.5, 0.5)])
def test_calibration_recovers_a_known_temperature(factor, start):
    """Labels drawn from softmax(logits / factor); the likelihood's curvature gives the standard error."""
    count = 3000
    points = (2.0 * RNG.normal(size=(count, 1, 3))).astype(np.float32)
    clouds = PointCloud(jnp.asarray(points), jnp.zeros_like(points), jnp.ones((count, 1), bool))
    network = eqx.tree_at(lambda n: n.linear.weight, Toy(temperature=start), 2.0 * jnp.eye(3))
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
    np.testing.assert_array_equal(before.argmax(axis=1), after.argmax(axis=1))


def test_calibration_error_of_a_hand_made_example():
    """Confidences 0.9 (right), 0.78 (wrong), 0.52 and 0.55 (both right); no bin ends at one of them."""
    p = np.array([[0.9, 0.1], [0.22, 0.78], [0.52, 0.48], [0.45, 0.55]])
    labels = np.array([0, 0, 0, 1])
    for bins, expected in ((5, (0.1 + 0.78 + 0.48 + 0.45) / 4), (3, (0.48 + 0.45 + 1.68 - 1) / 4), (2, 0.25 / 4)):
        assert expected_calibration_error(np.log(p), labels, bins=bins) == pytest.approx(expected)


def test_calibration_error_of_a_calibrated_classifier_is_nothing():
    p = np.concatenate([np.tile([0.75, 0.25], (4, 1)), np.tile([0.4, 0.6], (5, 1)), np.tile([1.0, 0.0], (2, 1))])
    labels = np.array([0, 0, 0, 1, 1, 1, 1, 0, 0, 0, 0])
    with np.errstate(divide="ignore"):
        assert expected_calibration_error(np.log(p), labels) == pytest.approx(0.0, abs=1e-12)
        assert expected_calibration_error(np.log(p), 1 - labels) > 0.3
