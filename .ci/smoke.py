"""Each dependency is used once, at small settings: `python .ci/smoke.py` in an environment with a wheel."""

import importlib
import importlib.util
import pkgutil
import subprocess
import sys
import tempfile
from pathlib import Path

import jax
import numpy as np
import optimistix

import jaxnbv as nbv
from jaxnbv.networks import load_checkpoint, pretrained_classifier, save_checkpoint
from jaxnbv.studies.scenes import demo_object

CAMERA = nbv.Camera(height=16, width=16)
FIRST = nbv.look_at((0.0, 0.0, 2.5))
MODEL = nbv.ScreenedSPSR(nbv.GeometricSPSR(0.02, 0.2, 12))
SAMPLER = nbv.SurfaceSampler(MODEL, grid=nbv.Grid(24), num_samples=2)


def command(*arguments: str) -> str:
    return subprocess.run(
        [Path(sys.executable).with_name("jaxnbv"), *arguments], check=True, text=True, stdout=-1
    ).stdout


def planning() -> None:
    """What needs no extra: an episode, a session on disk, networks."""
    bfgs = optimistix.BFGS(1e-3, 1e-3)
    searches = (
        nbv.DiscreteSearch(4),
        nbv.GradientSearch(num_starts=2, iterations=2, num_candidates=4),
        nbv.GradientSearch(num_starts=2, iterations=2, num_candidates=4, solver=bfgs),
    )
    scene = demo_object()
    with tempfile.TemporaryDirectory() as folder:
        for number, search in enumerate(searches):
            planner = nbv.Planner(nbv.Coverage(), search, CAMERA, SAMPLER, capacity=512)
            out = Path(folder) / str(number)
            assert len(nbv.simulate(planner, scene, FIRST, 2, jax.random.key(0), folder=out, progress=False).views) == 2
        box = nbv.Box((-1.5,) * 3, (1.5,) * 3)
        session = nbv.Session(CAMERA, box, planner, up="y", folder=Path(folder) / "session", progress=False)
        scan = nbv.scan(scene, CAMERA, FIRST)
        depth = np.where(scan.mask, (np.asarray(scan.points) - FIRST.position) @ FIRST.forward, 0.0)
        session.add(depth.reshape(16, 16), FIRST.matrix)
        assert np.isfinite(session.next().value)
        classifier = pretrained_classifier("pyramid", num_points=64)
        save_checkpoint(classifier.network, Path(folder) / "net.safetensors")
        assert load_checkpoint(Path(folder) / "net.safetensors").classes == classifier.classes


def everything() -> None:
    """What `jaxnbv[studies]` brings; pymeshlab and viser are extras of their own."""
    for module in pkgutil.walk_packages(nbv.__path__, "jaxnbv."):
        importlib.import_module(module.name)
    for action in ((), ("run",), ("demo",), ("study",)):
        assert "Usage" in command(*action, "--help")
    with tempfile.TemporaryDirectory() as folder:
        solid = nbv.mesh_from_sdf(demo_object().sdf, nbv.Grid(32)).to_trimesh()
        for suffix in ("off", "stl", "ply", "glb", "obj"):
            path = Path(folder) / f"mug.{suffix}"
            solid.export(path)
            mesh = nbv.load_mesh(path)
        heat = nbv.ExpectedUtilityImprovement(nbv.ColdestPoint(mesh.vertices[0], workers=2), num_points=256)
        planner = nbv.Planner(heat, nbv.DiscreteSearch(4), CAMERA, SAMPLER, capacity=512)
        episode = nbv.simulate(planner, mesh, FIRST, 2, jax.random.key(0), progress=False)
        assert nbv.write_report(episode, Path(folder) / "report", progress=False).exists()


def refused() -> None:
    """Without the extras, what needs one says which."""
    for use, extra in ((lambda: nbv.write_report, "report"), (lambda: nbv.ColdestPoint((0.0, 0.0, 0.0)), "heat")):
        said = ""
        try:
            use()
        except nbv.InputError as error:
            said = str(error)
        assert f".[{extra}]" in said


if __name__ == "__main__":
    assert nbv.__version__ in command("--version")
    planning()
    everything() if importlib.util.find_spec("matplotlib") else refused()
    print("works")
