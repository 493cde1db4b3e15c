"""Notebooks run from top to bottom at small settings (their cell tagged `parameters` is replaced), and their stored
outputs belong to their code."""

import re
import runpy
from pathlib import Path

import nbformat
import pytest
from jupyter_client.manager import KernelManager
from nbclient import NotebookClient

ROOT = Path(__file__).resolve().parents[1]
NOTEBOOKS = ROOT / "notebooks"
EACH = pytest.mark.parametrize("name", sorted(path.name for path in NOTEBOOKS.glob("*.ipynb")))

MODEL = "model = nbv.ScreenedSPSR(nbv.GeometricSPSR((0.05, 0.1), (0.2, 0.25), truncation=8))"
# The same sizes everywhere, so that notebooks share compiled programs.
SIZES = "num_samples, resolution, pixels, num_candidates, capacity, views = 2, 24, 12, 12, 512, 2"
SMALL = {
    "01_quickstart.ipynb": f"{MODEL}\n{SIZES}",
    "02_your_own_utility.ipynb": f"quick = True\n{SIZES}",
    "03_gradient_search.ipynb": f"{MODEL}\n{SIZES}\niterations = 3",
    "04_heat_on_your_mesh.ipynb": f"{MODEL}\n{SIZES}\nmesh_file, num_points = None, 300",
    "05_your_own_surface_model.ipynb": f"{SIZES}\nnum_features = 60",
    "06_a_depth_camera.ipynb": f"{MODEL}\n{SIZES}\nmost = 2",
    "07_a_study_of_your_own.ipynb": """
scenes = 3
settings = {
    "views": 2,
    "sampler": nbv.SurfaceSampler(nbv.GeometricSPSR(0.05, truncation=8)),
    "num_samples": 2,
    "num_candidates": 8,
    "grid_resolution": 24,
    "capacity": 300,
    "camera": nbv.Camera(height=12, width=12),
}
""",
    "08_objects_you_know.ipynb": f"{SIZES}\nnum_starts = 512",
    "09_which_part_is_it.ipynb": "pixels, num_candidates, capacity, views = 64, 12, 800, 2",
}


def stored(name):
    return nbformat.read(NOTEBOOKS / name, as_version=4)


def code_cells(notebook):
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


def kinds(cell):
    """Kinds of outputs of a cell: text, pictures, pages."""
    outputs = set()
    for output in cell.outputs:
        outputs |= (
            {output.name} if output.output_type == "stream" else {kind for kind in output.data if kind != "text/plain"}
        )
    return outputs


def wording(cell):
    """Lines that a cell prints, without numbers and blanks."""
    text = "".join(output.text for output in cell.outputs if output.get("name") == "stdout")
    lines = (re.sub(r"\s", "", re.sub(r"[-+]?\d+(\.\d*)?(e[-+]?\d+)?", "#", line)) for line in text.splitlines())
    return {line for line in lines if line}


@EACH
def test_stored_outputs_belong_to_this_code(name):
    """If it fails, run python scripts/run_notebooks.py NAME."""
    script, notebook = runpy.run_path(str(ROOT / "scripts" / "run_notebooks.py")), stored(name)
    assert notebook.metadata["jaxnbv"]["code"] == script["code_hash"](notebook)
    cells = code_cells(notebook)
    assert [cell.execution_count for cell in cells] == list(range(1, len(cells) + 1))
    outputs = [output for cell in cells for output in cell.outputs]
    assert all(output.output_type != "error" and output.get("name") != "stderr" for output in outputs)
    assert any("image/png" in output.get("data", {}) for output in outputs)
    assert (NOTEBOOKS / name).stat().st_size <= script["LARGEST"] <= 2**20


@pytest.fixture(scope="module")
def kernel():
    """One kernel for all notebooks, which share compiled programs and no names."""
    manager = KernelManager(kernel_name="python3")
    manager.start_kernel()
    yield manager
    manager.shutdown_kernel(now=True)


@pytest.mark.slow
@EACH
def test_notebook_runs(name, kernel, tmp_path):
    """Every cell has outputs of the same kinds as the stored ones, with the same words."""
    notebook = stored(name)
    (cell,) = (cell for cell in notebook.cells if "parameters" in cell.metadata.get("tags", []))
    cell.source = SMALL[name]
    notebook.cells.insert(0, nbformat.v4.new_code_cell(f"%reset -f\n%cd -q {tmp_path}"))
    NotebookClient(notebook, km=kernel, timeout=600).execute()
    notebook.cells.pop(0)
    printed = [output["text"] for cell in notebook.cells for output in cell.get("outputs", []) if "text" in output]
    assert any("next view from" in text for text in printed)
    for now, before in zip(code_cells(notebook), code_cells(stored(name)), strict=True):
        assert kinds(now) - {"stderr"} == kinds(before), before.source
        # Some of the printed lines may depend on the settings.
        assert wording(now) & wording(before) or wording(now) == wording(before) == set(), before.source
