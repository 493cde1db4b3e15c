"""Time one cross-entropy step of the shipped classifier at the authors' settings, and the share of each stage.

    python benchmarks/cross_entropy.py [--out results.json]

16 samples, 120 candidates, 50 x 50 rays, L = 50, grid 100^3: 1,920 imagined clouds of 1,024 points. Every stage is
timed after compilation, as the least of several runs.
"""

import argparse
import json
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
from timing import least_time

import jaxnbv as nbv
from jaxnbv.networks import pyramid_classifier
from jaxnbv.planning.episode import observe_scene
from jaxnbv.search.candidates import sphere_candidates
from jaxnbv.storage.folders import versions
from jaxnbv.studies.scenes import Framing, Split, hidden_view, pyramid_scene

LIMIT = 30.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/cross_entropy.json"))
    arguments = parser.parse_args()

    key, pyramid = jax.random.key(0), pyramid_scene(Split.TEST, 0, Framing.CLOSE_UP)
    classifier = pyramid_classifier(Framing.CLOSE_UP.longest_side)
    acquisition = nbv.CrossEntropy(classifier)
    planner = nbv.Planner(acquisition, imagination=nbv.Imagination(nbv.GeometricSPSR()))
    first = hidden_view(pyramid, key)
    seen = observe_scene(nbv.SDFSurface(pyramid), planner.camera, first, nbv.SensorNoise(), key)
    evidence = planner.init(first, seen)
    surfaces, poses = planner.imagination.sample(evidence, key), sphere_candidates(120, 2.5)
    context = acquisition.context(evidence.cloud)

    @eqx.filter_jit
    def scanned(surfaces):
        return nbv.scan_samples(surfaces, planner.camera, poses)

    scans = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), scanned(surfaces))

    @eqx.filter_jit
    def thinned(scans):
        def one(scan):
            return nbv.farthest_point_subsample(nbv.concatenate(context[0], scan), classifier.num_points)

        return jax.lax.map(one, scans)

    fed = thinned(scans)

    @eqx.filter_jit
    def answers(fed):
        return jax.lax.map(lambda cloud: classifier.network(cloud.points, cloud.normals, cloud.mask), fed)

    seconds = {
        "posterior samples on the grid": least_time(lambda: planner.imagination.sample(evidence, key)),
        "scan of 16 samples from 120 candidates": least_time(lambda: scanned(surfaces)),
        "farthest point sampling of 1,920 clouds": least_time(lambda: thinned(scans)),
        "network on 1,920 clouds": least_time(lambda: answers(fed)),
    }
    whole = least_time(lambda: planner.propose(evidence, key))
    matrix = jax.random.normal(key, (2000, 2000))
    product = jax.jit(jnp.matmul)
    yardstick = least_time(lambda: product(matrix, matrix), 10)

    print(f"{jax.devices()[0].device_kind}; {int(evidence.cloud.count)} points")
    for name, value in seconds.items():
        print(f"{name:42s} {value:7.2f} s {value / whole:6.0%}")
    missed = f"  {whole / LIMIT:.2f} x the limit" if whole > LIMIT else ""
    print(f"{'one whole step':42s} {whole:7.2f} s   at most {LIMIT:.0f}{missed}")
    print(f"{'yardstick: 2,000^3 float32 product':42s} {yardstick:7.3f} s")
    record = {"versions": versions(), "seconds": {**seconds, "step": whole, "yardstick": yardstick}, "at_most": LIMIT}
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    arguments.out.write_text(json.dumps(record, indent=2) + "\n")


if __name__ == "__main__":
    main()
