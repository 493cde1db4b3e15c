"""Registry entries (`Entry`) of the studies that ship with the package."""

from pathlib import Path
from typing import Annotated, Any

import typer

from jaxnbv.studies.registry import Entry
from jaxnbv.studies.scenes.framing import FirstView, Framing, Setup


def _option(kind: Any, text: str, default: str, metavar: str | None = None) -> Any:
    """Return the annotation of an option whose default is None. The help shows the text `default`."""
    return Annotated[kind | None, typer.Option(help=text, show_default=default, metavar=metavar)]


MESHES = {"meshes": _option(Path, "A folder of meshes to scan.", "procedural objects")}
CLASSES = {
    "classifier": _option(Path, "Checkpoint of a network: .safetensors, .pth or .pt.", "the shipped network"),
    "first": _option(FirstView, "Allowed first views: any, or only views after which the classifier is wrong.", "any"),
}
FRAMING = {
    "framing": _option(Framing, "Size of the pyramid: a view shows a patch of it, or nearly all of one side.", "both")
}
RECORDING = {
    "folder": Annotated[
        Path | None, typer.Argument(metavar="FOLDER", help="The folder of a recording.", show_default=False)
    ],
    "box": _option(
        tuple[float, float, float, float, float, float],
        "Region of interest of a recording: two corners of a box, six numbers in its units.",
        "a box around nearly all recorded points",
        "LOW HIGH",
    ),
    "up": _option(
        tuple[float, float, float],
        "Upward direction of a recording. It becomes the z axis of the box.",
        "as recorded",
        "X Y Z",
    ),
    "intrinsics": _option(
        tuple[float, float, float, float],
        "Intrinsics of a recording's depth camera, in pixels.",
        "the file in its folder or the parent folder",
        "FX FY CX CY",
    ),
    "depth_scale": _option(
        float,
        "Length of one unit of the depth images, in the units of the poses: 0.0002 for TUM RGB-D.",
        "the common scale for which the frames agree",
    ),
}
KNOWN_PARTS = {
    "parts": _option(Path, "A folder of meshes of the parts, at true size.", "parts that look alike"),
    "setup": _option(
        Setup,
        "Setup of the part: one side in view, a patch in view, on a table, or on a table beside a box.",
        "all four",
    ),
}

PYRAMID = Entry(
    "jaxnbv.studies.classification.objects:PyramidStudy",
    "Which pattern is on a pyramid's base? How many views does each method need to find it?",
    scenes=100,
    views=5,
    model="known",
    options=FRAMING | CLASSES,
)
TRUCK = Entry(
    "jaxnbv.studies.classification.objects:TruckStudy",
    "What does a truck carry? Most views do not show the cargo. The paper's Truck-ModelNet10, on procedural trucks and "
    "cargo, or on meshes: a folder `trucks` and one folder per class of cargo.",
    scenes=100,
    views=5,
    model="known",
    options=MESHES | CLASSES,
)
HOUSEHOLD = Entry(
    "jaxnbv.studies.classification.objects:HouseholdStudy",
    "Which household object is it? The classes differ in global shape. The paper's ModelNet10, on procedural objects, "
    "or on meshes in one folder per class.",
    scenes=100,
    views=5,
    model="known",
    options=MESHES | CLASSES,
)
OMNIOBJECT3D = Entry(
    "jaxnbv.studies.classification.objects:OmniObject3DStudy",
    "Which fruit is it? The classes differ in small details. The paper's OmniObject3D, on your meshes in one folder "
    "per class, with your classifier.",
    scenes=100,
    views=5,
    options=MESHES | CLASSES,
)
PARTS = Entry(
    "jaxnbv.studies.parts.study:PartStudy",
    "How many views until all parts are found? The paper's Table 1, on procedural objects, or on "
    "meshes whose nodes are their parts, in one folder per class.",
    scenes=80,
    views=6,
    model="known",
    options=MESHES,
)
HEAT = Entry(
    "jaxnbv.studies.heat:HeatStudy",
    "Where is a heated object coldest? The objects are procedural, with a coldest point that few views show, or your "
    "meshes, heated at one place.",
    scenes=24,
    views=6,
    model="known",
    options=MESHES,
)
RECONSTRUCTION = Entry(
    "jaxnbv.studies.reconstruction:ReconstructionStudy",
    "How near is the reconstructed surface to the true one? The supplement's table.",
    scenes=32,
    views=5,
    options=MESHES,
)
RECORDED = Entry(
    "jaxnbv.studies.recorded:RecordedStudy",
    "Which frames of a recording show the most of a box? The recording is a folder of 7-Scenes, of TUM RGB-D, or with "
    "a frames.json (see RecordedFrames).",
    scenes=6,
    views=6,
    options=RECORDING,
)
IDENTIFICATION = Entry(
    "jaxnbv.studies.identification:IdentificationStudy",
    "Which known part is it, and how does it lie? On your own parts, or on parts that look alike.",
    scenes=40,
    views=4,
    model="known",
    options=KNOWN_PARTS,
)
