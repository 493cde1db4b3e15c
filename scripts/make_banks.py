"""Make the banks of known shapes that ship with jaxnbv: `python scripts/make_banks.py [NAME ...] [--household FOLDER]`.

Those of procedural objects take half a minute; that of real ones needs the meshes of the CC0 catalogue of Sweet Home
3D, in folders of their classes.
"""

import argparse
from pathlib import Path

from jaxnbv.studies.scenes.banks import KINDS, REAL, made_bank, write_bank
from jaxnbv.surfaces import ShapeBank

BANKS = Path(__file__).parents[1] / "jaxnbv" / "studies" / "scenes" / "shapes"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", default=list(KINDS), help="which")
    parser.add_argument("--household", type=Path, help="folder of real meshes, class/cc-0_name.glb")
    arguments = parser.parse_args()
    BANKS.mkdir(exist_ok=True)
    for name in arguments.names:
        write_bank(BANKS / f"{name}.npz", made_bank(name))
    if arguments.household is not None:
        files = sorted(arguments.household.glob("*/cc-0_*.glb"))
        names = [f"{file.parent.name.replace('_', ' ')} {file.stem.removeprefix('cc-0_')}" for file in files]
        write_bank(BANKS / f"{REAL}.npz", ShapeBank.from_meshes(files, names=names))
    for file in sorted(BANKS.iterdir()):
        print(f"{file.name}: {file.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
