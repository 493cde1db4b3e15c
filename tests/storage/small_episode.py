"""A small episode, and its run into a folder."""

from pathlib import Path

import jax
from small_planner import FIRST, SCENE, planner_of

from jaxnbv.planning.simulate import simulate
from jaxnbv.scanning import SensorNoise

KEY = jax.random.key(0)
BASE = {"planner": planner_of(), "scene": SCENE, "noise": SensorNoise(), "first": FIRST, "key": KEY}


def run(folder, views=3, **changes):
    return simulate(**(BASE | changes), views=views, folder=folder, progress=False)


def contents(folder):
    """Contents of all files except the lock."""
    return {file.name: file.read_bytes() for file in sorted(Path(folder).iterdir()) if file.name != ".lock"}
