"""Each dependency is used once, at small settings: `python .ci/smoke.py` in an environment with a wheel."""

import importlib
import pkgutil
import subprocess
import sys
import tempfile
from pathlib import Path

import jax
import optimistix

import jaxnbv as nbv
from jaxnbv.networks import load_checkpoint, pyramid_classifier, save_checkpoint
from jaxnbv.studies.scenes import demo_object
from jaxnbv.viz import write_report


def command(*arguments: str) -> str:
    return subprocess.run(
        [Path(sys.executable).with_name("jaxnbv"), *arguments], check=True, text=True, stdout=-1
    ).stdout


def main() -> None:
    # pymeshlab is an extra of its own.
    for module in pkgutil.walk_packages(nbv.__path__, "jaxnbv."):
        importlib.import_module(module.name)
    for action in ((), ("run",), ("demo",), ("study",), ("study", "pyramid")):
        assert "Usage" in command(*action, "--help")
    assert nbv.__version__ in command("--version")

    with tempfile.TemporaryDirectory() as folder:
        solid = nbv.mesh_from_sdf(demo_object().sdf, nbv.Grid(32)).to_trimesh()
        for suffix in ("off", "stl", "ply", "glb", "obj"):
            path = Path(folder) / f"mug.{suffix}"
            solid.export(path)
            mesh = nbv.load_mesh(path)
        model, camera = nbv.ScreenedSPSR(nbv.GeometricSPSR(0.02, 0.2, 12)), nbv.Camera(height=16, width=16)
        imagination = nbv.Imagination(model, grid=nbv.Grid(24), num_samples=2)
        heat = nbv.ExpectedUtilityImprovement(nbv.ColdestPoint(mesh.vertices[0], workers=2), num_points=256)
        bfgs = optimistix.BFGS(1e-3, 1e-3)
        tasks = (
            (nbv.Coverage(), nbv.GradientSearch(num_starts=2, iterations=2, num_candidates=4)),
            (nbv.Coverage(), nbv.GradientSearch(num_starts=2, iterations=2, num_candidates=4, solver=bfgs)),
            (heat, nbv.DiscreteSearch(4)),
        )
        for acquisition, search in tasks:
            planner = nbv.Planner(acquisition, search, camera, imagination, capacity=512)
            episode = nbv.simulate(planner, mesh, nbv.look_at((0.0, 0.0, 2.5)), 2, jax.random.key(0), progress=False)
            assert len(episode.views) == 2
        assert write_report(episode, Path(folder) / "report", progress=False).exists()
        classifier = pyramid_classifier(num_points=64)
        save_checkpoint(classifier.network, Path(folder) / "net.safetensors")
        assert load_checkpoint(Path(folder) / "net.safetensors").classes == classifier.classes
    print("works")


if __name__ == "__main__":
    main()
