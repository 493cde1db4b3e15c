"""The notebooks run from top to bottom, at small settings: their cell tagged `parameters` is replaced."""

from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

NOTEBOOKS = Path(__file__).resolve().parents[1] / "notebooks"

MODEL = "model = nbv.ScreenedSPSR(nbv.GeometricSPSR((0.02, 0.06), (0.2, 0.25), truncation=16))"
SMALL = {
    "01_quickstart.ipynb": f"""
{MODEL}
num_samples, resolution, pixels, num_candidates, capacity, views = 4, 40, 20, 24, 1024, 2
""",
    "02_your_own_utility.ipynb": """
num_samples, resolution, pixels, num_candidates, quick, capacity, views = 2, 40, 24, 12, True, 1024, 2
""",
    "03_gradient_search.ipynb": f"""
{MODEL}
num_samples, resolution, pixels, num_candidates, capacity, iterations = 2, 40, 16, 12, 1024, 3
""",
    "04_heat_on_your_mesh.ipynb": f"""
{MODEL}
mesh_file = None
num_samples, resolution, pixels, num_candidates, num_points, capacity, views = 2, 40, 20, 6, 300, 1024, 2
""",
}


def test_every_notebook_is_run():
    assert {path.name for path in NOTEBOOKS.glob("*.ipynb")} == set(SMALL)


@pytest.mark.parametrize("name", SMALL)
def test_notebook_runs(name, tmp_path):
    notebook = nbformat.read(NOTEBOOKS / name, as_version=4)
    (cell,) = (cell for cell in notebook.cells if "parameters" in cell.metadata.get("tags", []))
    cell.source = SMALL[name]
    resources = {"metadata": {"path": str(tmp_path)}}
    NotebookClient(notebook, timeout=600, kernel_name="python3", resources=resources).execute()
    printed = [output["text"] for cell in notebook.cells for output in cell.get("outputs", []) if "text" in output]
    assert any("next view from" in text for text in printed)
