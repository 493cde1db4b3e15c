"""Run notebooks and store their outputs: `python scripts/run_notebooks.py [NAME ...]`. Without a name, runs all.

A hash of the code is stored with the outputs, so that the tests notice outputs of other code.
"""

import argparse
import base64
import hashlib
import io
import tempfile
import time
from pathlib import Path

import nbformat
from nbclient import NotebookClient
from nbformat import NotebookNode
from PIL import Image

NOTEBOOKS = Path(__file__).resolve().parents[1] / "notebooks"
LARGEST = 1_000_000
# XLA's warning on a busy machine, which is no output of the notebook.
_SLOW = "slow_operation_alarm"


def code_hash(notebook: NotebookNode) -> str:
    """Hash of all code cells in order."""
    code = [cell.source for cell in notebook.cells if cell.cell_type == "code"]
    return hashlib.sha256("\0".join(code).encode()).hexdigest()


def run(path: Path, folder: str) -> None:
    """Run a notebook in a folder, where it may write files, and store it with its outputs."""
    notebook = nbformat.read(path, as_version=4)
    start = time.perf_counter()
    NotebookClient(notebook, timeout=1800, kernel_name="python3", resources={"metadata": {"path": folder}}).execute()
    seconds = time.perf_counter() - start
    for cell in notebook.cells:
        cell.metadata.pop("execution", None)
        if cell.cell_type == "code":
            cell.outputs = [output for output in cell.outputs if _SLOW not in output.get("text", "")]
        for output in cell.get("outputs", []):
            if "image/png" in output.get("data", {}):
                output.data["image/png"] = _fewer_colours(output.data["image/png"])
    notebook.metadata["jaxnbv"] = {"code": code_hash(notebook)}
    # The version of Python is no part of the outputs.
    notebook.metadata["language_info"] = {"name": "python"}
    text = nbformat.writes(notebook)
    if len(text.encode()) > LARGEST:
        raise ValueError(f"{path.name} would have {len(text.encode())} bytes, more than {LARGEST}: show less")
    path.write_text(f"{text}\n")
    print(f"{path.name}   {len(text) // 1000} KB   {seconds:.0f} s")


def _fewer_colours(png: str) -> str:
    """The PNG in base64, with 256 colours."""
    file = io.BytesIO()
    Image.open(io.BytesIO(base64.b64decode(png))).convert("RGB").quantize(256).save(file, "png", optimize=True)
    return base64.b64encode(file.getvalue()).decode()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help="files of the folder notebooks")
    paths = [NOTEBOOKS / name for name in parser.parse_args().names] or sorted(NOTEBOOKS.glob("*.ipynb"))
    for path in paths:
        with tempfile.TemporaryDirectory() as folder:
            run(path, folder)


if __name__ == "__main__":
    main()
