"""The published PointNet++ in NumPy: random tensors under its names, and its outputs."""

import itertools

import jax.numpy as jnp
import numpy as np

from jaxnbv.networks.layers import Linear

# Centres, radii and members of each level.
CLASSIFIERS = {
    "ssg": ((512, (0.2,), (32,)), (128, (0.4,), (64,))),
    "msg": ((512, (0.1, 0.2, 0.4), (16, 32, 128)), (128, (0.2, 0.4, 0.8), (32, 64, 128))),
}


def layers(rng, *widths):
    return tuple(
        Linear(jnp.asarray(rng.normal(size=(a, b)) * (2 / a) ** 0.5), jnp.asarray(0.2 * rng.normal(size=b)))
        for a, b in itertools.pairwise(widths)
    )


def random_state(rng, kind, sampling, inputs, head):
    """Tensors of a narrow network. `head` gives names, widths and kernels of the layers after the levels, from their
    widths."""
    state = {}

    def put(linear, norm, a, b, kernel=(1, 1)):
        state[f"{linear}.weight"] = rng.normal(size=(b, a, *kernel)) * (2 / a) ** 0.5
        state[f"{linear}.bias"] = 0.1 * rng.normal(size=b)
        if norm:
            state[f"{norm}.weight"], state[f"{norm}.running_var"] = rng.uniform(0.5, 1.5, (2, b))
            state[f"{norm}.bias"], state[f"{norm}.running_mean"] = 0.1 * rng.normal(size=(2, b))
            state[f"{norm}.num_batches_tracked"] = np.array(7)

    widths = [inputs - 3]
    for level, (_, radii, _) in enumerate(sampling, start=1):
        for branch in range(len(radii)):
            names = _names(kind, level, branch)
            for i, pair in enumerate(itertools.pairwise((3 + widths[-1], 5, 6 + branch))):
                put(*(f"{name}.{i}" for name in names), *pair)
        widths.append(sum(6 + branch for branch in range(len(radii))))
    put("sa3.mlp_convs.0", "sa3.mlp_bns.0", 3 + widths[-1], 8)
    put("sa3.mlp_convs.1", "sa3.mlp_bns.1", 8, 12)
    for layer in head(widths):
        put(*layer)
    return state


def classifier_state(rng, kind, inputs):
    """Tensors of a narrow classifier with four classes, for points, or for points with normals if there are six
    inputs."""
    head = [("fc1", "bn1", 12, 8, ()), ("fc2", "bn2", 8, 7, ()), ("fc3", None, 7, 4, ())]
    return random_state(rng, kind, CLASSIFIERS[kind], inputs, lambda widths: head)


def _names(kind, level, branch):
    names = ("mlp_convs", "mlp_bns") if kind == "ssg" else (f"conv_blocks.{branch}", f"bn_blocks.{branch}")
    return [f"sa{level}.{name}" for name in names]


def layer(state, x, linear, norm=None):
    weight = state[f"{linear}.weight"]
    x = x @ weight.reshape(weight.shape[:2]).T + state[f"{linear}.bias"]
    if norm is None:
        return x
    x = (x - state[f"{norm}.running_mean"]) / np.sqrt(state[f"{norm}.running_var"] + 1e-5)
    return np.maximum(x * state[f"{norm}.weight"] + state[f"{norm}.bias"], 0.0)


def perceptron(state, x, linear, norm):
    for i in range(2):
        x = layer(state, x, f"{linear}.{i}", f"{norm}.{i}")
    return x


def encode(state, kind, sampling, points, features):
    """Points and features of each level, and the global features, layer by layer with concatenations and batch
    normalisation."""
    stages = []
    for level, (count, radii, members) in enumerate(sampling, start=1):
        chosen, distance = [0], np.full(len(points), np.inf)
        while len(chosen) < count:
            distance = np.minimum(distance, ((points - points[chosen[-1]]) ** 2).sum(axis=1))
            chosen.append(int(np.argmax(distance)))
        levels = []
        for i in chosen:
            squared = ((points - points[i]) ** 2).sum(axis=1)
            row = []
            for branch, (radius, size) in enumerate(zip(radii, members, strict=True)):
                group = np.flatnonzero(squared <= radius**2)[:size]
                parts = [points[group] - points[i], features[group]]
                x = np.concatenate(parts if kind == "ssg" else parts[::-1], axis=1)
                row.append(perceptron(state, x, *_names(kind, level, branch)).max(axis=0))
            levels.append(np.concatenate(row))
        points, features = points[chosen], np.array(levels)
        stages.append((points, features))
    whole = perceptron(state, np.concatenate([points, features], axis=1), "sa3.mlp_convs", "sa3.mlp_bns")
    return stages, whole.max(axis=0)


def near_sphere(rng, n):
    """Points on the unit sphere, and unit normals near to the true ones."""
    points = rng.normal(size=(n, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    normals = points + 0.3 * rng.normal(size=(n, 3))
    return jnp.asarray(points), jnp.asarray(normals / np.linalg.norm(normals, axis=1, keepdims=True))
