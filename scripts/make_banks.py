"""Make the banks of known shapes that ship with jaxnbv: `python scripts/make_banks.py [NAME ...] [--household FOLDER]`.

Banks of procedural objects take half a minute. The bank of real objects needs the meshes of the CC0 catalogue of Sweet
Home 3D, in one folder for each class.
"""

import argparse
from pathlib import Path

import jax
import numpy as np

from jaxnbv.scanning.sdf import Sampled
from jaxnbv.studies.scenes.banks import RECIPES
from jaxnbv.surfaces import ShapeBank
from jaxnbv.surfaces.shipped_banks import QUANTUM

BANKS = Path(__file__).parents[1] / "jaxnbv" / "surfaces" / "shapes"


def write_bank(path: Path, bank: ShapeBank) -> None:
    """Write a bank. Floats have sixteen bits, integers and distances on grids have eight, see `read_bank`."""
    solids, extremes = bank.shapes
    leaves = [np.asarray(leaf) for leaf in (*jax.tree.leaves(solids), extremes)]
    if isinstance(solids, Sampled):
        steps = np.clip(np.round(leaves[0] / QUANTUM), -127, 127).astype(np.int8)
        # Neighbours are similar, so their differences compress better.
        leaves[0] = np.diff(steps, axis=-1, prepend=np.int8(0))
    narrow = {"f": np.float16, "i": np.int8, "b": np.bool_}
    arrays = {f"{index:02d}": leaf.astype(narrow[leaf.dtype.kind]) for index, leaf in enumerate(leaves)}
    np.savez_compressed(path, names=np.array(bank.names), **arrays)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", default=list(RECIPES), help="which")
    parser.add_argument("--household", type=Path, help="folder of real meshes, class/cc-0_name.glb")
    arguments = parser.parse_args()
    BANKS.mkdir(exist_ok=True)
    for name in arguments.names:
        write_bank(BANKS / f"{name}.npz", RECIPES[name].make())
    if arguments.household is not None:
        files = sorted(arguments.household.glob("*/cc-0_*.glb"))
        names = [f"{file.parent.name.replace('_', ' ')} {file.stem.removeprefix('cc-0_')}" for file in files]
        write_bank(BANKS / "household-real.npz", ShapeBank.from_meshes(files, names=names))
    for file in sorted(BANKS.iterdir()):
        print(f"{file.name}: {file.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
