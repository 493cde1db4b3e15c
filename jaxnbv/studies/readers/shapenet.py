"""ShapeNetCore (Chang et al. 2015), versions 1 and 2: meshes by category, from a local folder."""

from collections.abc import Iterable
from pathlib import Path

import equinox as eqx

from jaxnbv.checks import checked, require
from jaxnbv.storage.files import is_file
from jaxnbv.studies.readers.local_copy import as_names, checked_folder, chosen_folders, class_name, first, present
from jaxnbv.studies.readers.mesh_set import MeshFile, MeshSet

# The folders of both versions, by WordNet 3.0: the first has a boat and a bicycle besides.
SYNSETS = {
    "airplane": "02691156",
    "bag": "02773838",
    "basket": "02801938",
    "bathtub": "02808440",
    "bed": "02818832",
    "bench": "02828884",
    "bicycle": "02834778",
    "birdhouse": "02843684",
    "boat": "02858304",
    "bookshelf": "02871439",
    "bottle": "02876657",
    "bowl": "02880940",
    "bus": "02924116",
    "cabinet": "02933112",
    "camera": "02942699",
    "can": "02946921",
    "cap": "02954340",
    "car": "02958343",
    "cellphone": "02992529",
    "chair": "03001627",
    "clock": "03046257",
    "dishwasher": "03207941",
    "display": "03211117",
    "earphone": "03261776",
    "faucet": "03325088",
    "file cabinet": "03337140",
    "flowerpot": "03991062",
    "guitar": "03467517",
    "helmet": "03513137",
    "jar": "03593526",
    "keyboard": "03085013",
    "knife": "03624134",
    "lamp": "03636649",
    "laptop": "03642806",
    "loudspeaker": "03691459",
    "mailbox": "03710193",
    "microphone": "03759954",
    "microwave": "03761084",
    "motorbike": "03790512",
    "mug": "03797390",
    "piano": "03928116",
    "pillow": "03938244",
    "pistol": "03948459",
    "printer": "04004475",
    "remote": "04074963",
    "rifle": "04090263",
    "rocket": "04099429",
    "skateboard": "04225987",
    "sofa": "04256520",
    "stove": "04330267",
    "table": "04379243",
    "telephone": "04401088",
    "tower": "04460130",
    "train": "04468005",
    "trash bin": "02747177",
    "washer": "04554684",
    "watercraft": "04530566",
}
_NAMES = {synset: name for name, synset in SYNSETS.items()}
# Of the second version, and of the first.
_MESHES = ("models/model_normalized.obj", "model.obj")


class ShapeNet(MeshSet):
    """The meshes of some categories, `<synset>/<model>/models/model_normalized.obj` or `<synset>/<model>/model.obj`.

    In the files of both versions the y axis points up, in those of the second -z to the front, and sizes are
    normalised; here the longest side is 2.5. ShapeNet has no category of trucks: those with an open bed are among its
    cars, from which they are chosen by their identifiers.
    """

    classes: tuple[str, ...] = eqx.field(static=True)
    files: tuple[MeshFile, ...] = eqx.field(static=True)

    @checked
    def __init__(self, folder: str | Path, categories: str | Iterable[str], models: str | Iterable[str] | None = None):
        """The meshes of one category or several, each given by its name in `SYNSETS` or as a synset of eight digits.

        - `models`: identifiers, such as those of trucks; default: all. Of these some have no mesh in the data set
          itself; they are named by a `UserWarning`.

        **Raises:** `ValueError` for an unknown category, a folder that is missing, a model that is given and not there,
        or no mesh at all.
        """
        folder = checked_folder(folder)
        folders = chosen_folders(folder, map(_synset, as_names(categories, "category")))
        self.classes = tuple(_NAMES.get(synset, synset) for synset in folders)
        wanted = None if models is None else as_names(models, "model")
        self.files = tuple(
            MeshFile(label, path.relative_to(of_category).parts[0], str(path))
            for label, of_category in enumerate(folders.values())
            for path in _meshes(of_category, wanted)
        )
        absent = sorted({*(wanted or ())} - {file.name for file in self.files})
        places = " or ".join(map(str, folders.values()))
        require(
            not absent,
            f"{len(absent)} of the {len(wanted or ())} models have no mesh in {places}: {first(absent)}; unpack the "
            "data set again, or choose others",
        )


def _synset(category: str) -> str:
    name = class_name(category)
    synset = SYNSETS.get(name, name)
    require(
        len(synset) == 8 and synset.isdigit(),
        f"there is no category '{category}' in ShapeNet: give a synset, or choose from {', '.join(SYNSETS)}",
    )
    return synset


def _meshes(of_category: Path, models: Iterable[str] | None) -> list[Path]:
    """The files of the models that are there, by default of all."""
    mesh = next((name for name in _MESHES if any(of_category.glob(f"*/{name}"))), _MESHES[0])
    if models is not None:
        return [path for path in (of_category / model / mesh for model in models) if is_file(path)]
    folders = [path for path in sorted(of_category.iterdir()) if path.is_dir()]
    return present([path / mesh for path in folders], f"meshes of {of_category}")
