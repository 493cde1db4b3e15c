"""The studies of `jaxnbv study`, by name: what a command must know before anything heavy is imported.

A new study is a module with a `Study` and an entry here.
"""

from typing import NamedTuple


class Entry(NamedTuple):
    """One study.

    - `study`: module and class; `question`: for the help.
    - `scenes`, `views`, `model`: by default.
    - `options`: names of its fields that are options of the command.
    """

    study: str
    question: str
    scenes: int
    views: int
    model: str = "known"
    options: tuple[str, ...] = ()


def flag(option: str) -> str:
    """How an option of a study is given."""
    return "FOLDER" if option == "folder" else f"--{option}"


STUDIES = {
    "pyramid": Entry(
        "jaxnbv.studies.classification.objects:PyramidStudy",
        "Which methods find the pattern on a pyramid's base, and how soon is its class known?",
        scenes=100,
        views=5,
        options=("framing", "classifier", "first"),
    ),
    "truck": Entry(
        "jaxnbv.studies.classification.objects:TruckStudy",
        "How soon is the class of a truck's cargo known, which most views do not show? The paper's Truck-ModelNet10, "
        "on procedural trucks and cargo, or on meshes: a folder `trucks`, and folders of the classes' names.",
        scenes=100,
        views=5,
        options=("meshes", "classifier", "first"),
    ),
    "household": Entry(
        "jaxnbv.studies.classification.objects:HouseholdStudy",
        "Do all methods tell classes alike that differ in global shape? The paper's ModelNet10, on procedural objects, "
        "or on meshes in folders of the classes' names.",
        scenes=100,
        views=5,
        options=("meshes", "classifier", "first"),
    ),
    "omniobject3d": Entry(
        "jaxnbv.studies.classification.objects:OmniObject3DStudy",
        "How soon are fruits told that differ in what is small? The paper's OmniObject3D, on meshes of yours in "
        "folders of the classes' names, with a classifier of yours.",
        scenes=100,
        views=5,
        model="screened",
        options=("meshes", "classifier", "first"),
    ),
    "parts": Entry(
        "jaxnbv.studies.parts.study:PartStudy",
        "How many views until all parts of an object are found? The paper's Table 1, on procedural objects, or on "
        "meshes whose nodes are their parts, in folders of the classes' names.",
        scenes=80,
        views=6,
        options=("meshes",),
    ),
    "heat": Entry(
        "jaxnbv.studies.heat:HeatStudy",
        "How near does the coldest point of the scanned cloud come to the object's? On procedural objects whose "
        "coldest point hides, or on your meshes, heated at one place.",
        scenes=24,
        views=6,
        options=("meshes",),
    ),
    "reconstruction": Entry(
        "jaxnbv.studies.reconstruction:ReconstructionStudy",
        "How near is the surface that a method's views give to the true one? The table of the paper's supplement.",
        scenes=32,
        views=5,
        model="screened",
        options=("meshes",),
    ),
    "recorded": Entry(
        "jaxnbv.studies.recorded:RecordedStudy",
        "Which frames of a recorded sequence show the most of a box? On a folder of 7-Scenes, of TUM RGB-D, or with a "
        "frames.json (see RecordedFrames).",
        scenes=6,
        views=6,
        model="screened",
        options=("folder", "box", "up"),
    ),
}
