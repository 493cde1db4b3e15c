"""The studies of `jaxnbv study`, by name: what a command must know before anything heavy is imported.

A new study is a module with a `Study` and an entry here.
"""

from typing import NamedTuple


class Entry(NamedTuple):
    """One study.

    - `study`: module and class.
    - `question`, `settings`: for the help.
    - `scenes`, `views`, `model`: by default.
    - `options`: names of its fields that are options of the command.
    """

    study: str
    question: str
    settings: str
    scenes: int
    views: int
    model: str = "known"
    options: tuple[str, ...] = ()


def flag(option: str) -> str:
    """How an option of a study is given."""
    return "FOLDER" if option == "folder" else f"--{option}"


def _of_classes(
    study: str,
    question: str,
    settings: str = "48 candidates, 16 samples on a 64^3 grid, and 512 points for the classifier of imagined scans: "
    "fewer candidates and a coarser grid than the paper's.",
    own: str = "meshes",
) -> Entry:
    """A study of classification, with one option of its own."""
    return Entry(study, question, settings, scenes=100, views=5, options=(own, "classifier", "first"))


STUDIES = {
    "pyramid": _of_classes(
        "jaxnbv.studies.classification.objects:PyramidStudy",
        "Which methods find the pattern on a pyramid's base, and how soon is its class known?",
        own="framing",
    ),
    "truck": _of_classes(
        "jaxnbv.studies.classification.objects:TruckStudy",
        "How soon is the class of a truck's cargo known, which most views do not show? The paper's Truck-ModelNet10, "
        "on procedural trucks and cargo, or on meshes: a folder `trucks`, and folders of the classes' names.",
        "48 candidates, 16 samples on a 64^3 grid, 1,024 points of what was seen beside an imagined scan and 2,048 of "
        "what was seen alone: fewer candidates and a coarser grid than the paper's.",
    ),
    "modelnet10": _of_classes(
        "jaxnbv.studies.classification.objects:ModelNet10Study",
        "Do all methods tell classes alike that differ in global shape? The paper's ModelNet10, on procedural objects, "
        "or on meshes in folders of the classes' names.",
    ),
    "omniobject3d": _of_classes(
        "jaxnbv.studies.classification.objects:OmniObject3DStudy",
        "How soon are fruits told that differ in what is small? The paper's OmniObject3D, on meshes of yours in "
        "folders of the classes' names, with a classifier of yours.",
    )._replace(model="screened"),
    "parts": Entry(
        "jaxnbv.studies.parts.study:PartStudy",
        "How many views until all parts of an object are found? The paper's Table 1, on procedural objects, or on "
        "meshes whose nodes are their parts, in folders of the classes' names.",
        "48 candidates at radius 2, 64 x 64 rays. Views are imagined with 32 x 32 rays, 8 samples on a 64^3 grid, and "
        "1,024 points for the segmenter, 2,048 for what it says of the cloud; gradient search climbs from the best 4 "
        "of 24 views, 8 steps of 0.03: less of everything than the paper.",
        scenes=80,
        views=6,
        options=("meshes",),
    ),
    "heat": Entry(
        "jaxnbv.studies.heat:HeatStudy",
        "How near does the coldest point of the scanned cloud come to the object's? On procedural objects whose "
        "coldest point hides, or on your meshes, heated at one place.",
        "32 candidates at radius 3, 50 x 50 rays. Views are imagined with 24 x 24 rays, 8 samples on a 64^3 grid, and "
        "added to 1,024 points of the cloud: less of everything than the paper.",
        scenes=24,
        views=6,
        options=("meshes",),
    ),
    "reconstruction": Entry(
        "jaxnbv.studies.reconstruction:ReconstructionStudy",
        "How near is the surface that a method's views give to the true one? The table of the paper's supplement.",
        "48 candidates, 16 samples on a 64^3 grid: fewer and coarser than the paper's.",
        scenes=32,
        views=5,
        model="screened",
        options=("meshes",),
    ),
    "recorded": Entry(
        "jaxnbv.studies.recorded:RecordedStudy",
        "Which frames of a recorded sequence show the most of a box? On a folder of 7-Scenes, of TUM RGB-D, or with a "
        "frames.json (see RecordedFrames).",
        "The recorded poses are the candidates. 24 x 32 rays, 8 samples on a 100^3 grid, and 2,000 points kept.",
        scenes=6,
        views=6,
        model="screened",
        options=("folder", "box", "up"),
    ),
}
