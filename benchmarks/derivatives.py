"""Compare the gradient of an acquisition in a 6-DOF pose with central differences.

    python benchmarks/derivatives.py [--mesh FILE] [--step 0.02] [--seeds 2]

Prints the cosine of the angle between the two, as median and minimum over eight poses around the object and all seeds,
after one view. The differences are over a step along each of the nine parameters of `FreePoses`. In close-up the object
fills the image. Whole, its silhouette is in view.
"""

import argparse
import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import jaxnbv as nbv
from jaxnbv.geometry.pose import Pose
from jaxnbv.sampler import StepInputs
from jaxnbv.studies.scenes import demo_object

FIELDS_OF_VIEW = {"close-up": 0.25, "whole": 1.0}
ACQUISITIONS = {"coverage": nbv.Coverage(), "new surface": nbv.NewSurface()}
POSES, RAYS, SAMPLES, RADIUS = 8, 48, 8, 2.5
SPACE = nbv.search.FreePoses()


@eqx.filter_jit
def values(planner: nbv.Planner, inputs: StepInputs, starts: Pose, parameters: Float[Array, "poses 9"]):
    poses = jax.vmap(SPACE.retract)(starts, parameters)
    return nbv.expected_value(planner.acquisition, inputs.observations, inputs.surfaces, planner.camera, poses)


@eqx.filter_jit
def gradients(planner: nbv.Planner, inputs: StepInputs, starts: Pose, parameters: Float[Array, "poses 9"]):
    return jax.grad(lambda moved: jnp.sum(values(planner, inputs, starts, moved)))(parameters)


def cosines(planner: nbv.Planner, scene, seed: int, step: float) -> np.ndarray:
    """Cosine of the angle between gradient and central differences at each pose."""
    first = nbv.look_at(RADIUS * np.array([0.6, 0.5, 0.62]))
    observations = planner.init(first, nbv.scan(scene, planner.camera, first))
    inputs = planner.step_inputs(observations, jax.random.key(seed))
    starts = nbv.look_at(np.asarray(nbv.geometry.fibonacci_sphere(POSES, RADIUS)))
    parameters = jnp.asarray(0.05 * np.random.default_rng(seed).normal(size=(POSES, SPACE.num_parameters)), jnp.float32)
    evaluate = functools.partial(values, planner, inputs, starts)
    differences = np.stack(
        [
            np.asarray(evaluate(parameters + move) - evaluate(parameters - move))
            for move in step * jnp.eye(parameters.shape[1])
        ],
        axis=1,
    )
    slopes = np.asarray(gradients(planner, inputs, starts, parameters))
    lengths = np.linalg.norm(slopes, axis=1) * np.linalg.norm(differences, axis=1)
    return np.sum(slopes * differences, axis=1) / np.maximum(lengths, 1e-12)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--mesh", help="a mesh file; the demo object if left out")
    parser.add_argument("--step", type=float, default=0.02)
    parser.add_argument("--seeds", type=int, default=2)
    options = parser.parse_args()
    scene = nbv.load_mesh(options.mesh) if options.mesh else demo_object()
    for framing, fov in FIELDS_OF_VIEW.items():
        for name, acquisition in ACQUISITIONS.items():
            sampler, camera = nbv.SurfaceSampler(num_samples=SAMPLES), nbv.Camera(fov, RAYS, RAYS)
            planner = nbv.Planner(acquisition, nbv.DiscreteSearch(), camera, sampler)
            values = np.concatenate([cosines(planner, scene, seed, options.step) for seed in range(options.seeds)])
            print(f"{name:12} {framing:9} median {np.median(values):5.2f}, least {values.min():5.2f}", flush=True)


if __name__ == "__main__":
    main()
