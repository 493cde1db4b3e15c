"""Time PointNet++ at its published sizes on this machine, against the time of its multiply-adds.

    python benchmarks/networks.py [--points 1024] [--batch 16] [--out results.json]

The yardstick is the rate of a 2,000^3 float32 matrix product. The multiply-adds are those of the published layers, each
for every member of every group. Weights are random, which does not change the work. Times are the least of several
runs, without compilation.
"""

import argparse
import json
from itertools import pairwise
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
from timing import least_time

from jaxnbv.geometry.farthest_points import farthest_point_indices
from jaxnbv.networks import PointNet2Classifier
from jaxnbv.networks.layers import Linear, PooledMLP, SetAbstraction, ball_query
from jaxnbv.networks.pointnet2 import MULTI_SCALE, SINGLE_SCALE
from jaxnbv.storage.folders import versions

NETWORKS = {
    "one radius": (SINGLE_SCALE, (((64, 64, 128),), ((128, 128, 256),))),
    "three radii": (
        MULTI_SCALE,
        (((32, 32, 64), (64, 64, 128), (64, 96, 128)), ((64, 64, 128), (128, 128, 256), (128, 128, 256))),
    ),
}
LIMIT = 2.5


def random_layers(key: jax.Array, *widths: int) -> tuple[Linear, ...]:
    keys = jax.random.split(key, len(widths))
    return tuple(
        Linear(jax.random.normal(k, pair) * (2 / pair[0]) ** 0.5, jnp.zeros(pair[1]))
        for k, pair in zip(keys, pairwise(widths), strict=False)
    )


def random_network(name: str, key: jax.Array) -> PointNet2Classifier:
    """The published network for 40 classes of oriented points, with random weights."""
    levels, inputs = [], 6
    for level, widths in zip(*NETWORKS[name], strict=True):
        branches = tuple(PooledMLP(random_layers(key, inputs, *branch)) for branch in widths)
        levels.append(SetAbstraction(branches, level.radii, level.members, level.centers))
        inputs = 3 + sum(branch[-1] for branch in widths)
    whole = PooledMLP(random_layers(key, inputs, 256, 512, 1024))
    *hidden, last = random_layers(key, 1024, 512, 256, 40)
    return PointNet2Classifier(tuple(levels), whole, tuple(hidden), last)


def multiply_adds(network: PointNet2Classifier) -> int:
    """Multiply-adds of the published layers for one cloud."""
    parts = [
        (level.centers * members, branch.layers)
        for level in network.levels
        for branch, members in zip(level.branches, level.members, strict=True)
    ]
    parts += [(network.levels[-1].centers, network.whole.layers), (1, (*network.hidden, network.last))]
    return sum(rows * sum(layer.weight.size for layer in layers) for rows, layers in parts)


def groups(network: PointNet2Classifier, points: jax.Array) -> list[jax.Array]:
    """Sampling and grouping at all levels, without the products."""
    indices = []
    for level in network.levels:
        mask = jnp.ones(len(points), dtype=bool)
        centers = points[farthest_point_indices(points, mask, level.centers)]
        rules = zip(level.radii, level.members, strict=True)
        indices += [ball_query(centers, points, mask, radius, members) for radius, members in rules]
        points = centers
    return indices


def timings(network: PointNet2Classifier, points: jax.Array, normals: jax.Array) -> dict[str, float]:
    """Seconds for one cloud."""
    first = network, points[0], normals[0]

    @eqx.filter_jit
    def classify_one(network, points, normals):
        return network(points, normals)

    @eqx.filter_jit
    def classify_in_turn(network, points, normals):
        return jax.lax.map(lambda cloud: network(*cloud), (points, normals))

    @eqx.filter_jit
    def classify_batch(network, points, normals):
        return jax.vmap(network)(points, normals)

    @eqx.filter_jit
    def differentiate(network, points, normals):
        return jax.value_and_grad(lambda points: network(points, normals)[0])(points)

    grouping = eqx.filter_jit(groups)
    return {
        "one cloud": least_time(lambda: classify_one(*first)),
        "each of a batch, lax.map": least_time(lambda: classify_in_turn(network, points, normals)) / len(points),
        "each of a batch, vmap": least_time(lambda: classify_batch(network, points, normals)) / len(points),
        "one cloud and its gradient": least_time(lambda: differentiate(*first)),
        "sampling and grouping of one": least_time(lambda: grouping(network, points[0])),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--points", type=int, default=1024)
    parser.add_argument("--batch", type=int, default=16)
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/networks.json"))
    arguments = parser.parse_args()

    key = jax.random.key(0)
    normals = jax.random.normal(key, (arguments.batch, arguments.points, 3))
    normals = normals / jnp.linalg.norm(normals, axis=-1, keepdims=True)
    points = normals * jnp.array([1.0, 0.7, 0.5])
    matrix = jax.random.normal(key, (2000, 2000))
    square = jax.jit(lambda a: jnp.matmul(a, a, precision="highest"))
    rate = 2000**3 / least_time(lambda: square(matrix), repeats=10)
    print(f"{jax.devices()[0].device_kind}; {arguments.points} points, batches of {arguments.batch}")
    print(f"2,000^3 float32 product: {2e-9 * rate:.0f} GFLOP/s")

    networks = {}
    for name in NETWORKS:
        network = random_network(name, key)
        floor = multiply_adds(network) / rate
        seconds = timings(network, points, normals)
        print(
            f"\n{name + ': ' + format(1e-9 * multiply_adds(network), '.2f') + ' GMAC':32s} {'ms':>8s} {'of floor':>9s}"
        )
        print(f"{'floor: the GMAC at that rate':32s} {1e3 * floor:8.2f} {1.0:9.2f}")
        for text, value in seconds.items():
            print(f"{text:32s} {1e3 * value:8.2f} {value / floor:9.2f}")
        share = seconds["sampling and grouping of one"] / seconds["one cloud"]
        print(f"sampling and grouping: {share:.0%} of one cloud")
        if seconds["one cloud"] > LIMIT * floor:
            print(f"one cloud takes more than {LIMIT} x the floor")
        networks[name] = {"gmac": 1e-9 * multiply_adds(network), "floor": floor, "seconds": seconds, "share": share}
    record = {
        "versions": versions(),
        "points": arguments.points,
        "batch": arguments.batch,
        "gflops": 2e-9 * rate,
        "networks": networks,
    }
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    arguments.out.write_text(json.dumps(record, indent=2) + "\n")


if __name__ == "__main__":
    main()
