"""The studies that ship, as their commands must know them; see `Entry`."""

from pathlib import Path
from typing import Annotated

import typer

from jaxnbv.studies.registry import Entry
from jaxnbv.studies.scenes.framing import FirstView, Framing, Setup

MESHES = {
    "meshes": Annotated[
        Path | None, typer.Option(help="A folder of meshes to scan.", show_default="procedural objects")
    ]
}
CLASSES = {
    "classifier": Annotated[
        Path | None,
        typer.Option(help="A network's checkpoint: .safetensors, .pth or .pt.", show_default="the one that ships"),
    ],
    "first": Annotated[
        FirstView | None,
        typer.Option(
            help="Which first views: any, or of classes only those after which the classifier is wrong.",
            show_default="any",
        ),
    ],
}
FRAMING = {
    "framing": Annotated[
        Framing | None,
        typer.Option(
            help="How large a pyramid stands: a view shows a patch of it, or nearly all.", show_default="both"
        ),
    ]
}
RECORDING = {
    "folder": Annotated[Path | None, typer.Argument(help="A recording, for recorded.", show_default=False)],
    "box": Annotated[
        tuple[float, float, float, float, float, float] | None,
        typer.Option(
            metavar="LOW HIGH",
            help="What is to be seen of a recording: two corners of a box, six numbers in its units.",
            show_default="about nearly all that was seen, with room",
        ),
    ],
    "up": Annotated[
        tuple[float, float, float] | None,
        typer.Option(
            metavar="X Y Z",
            help="The direction of a recording that is upward, which becomes z of the box.",
            show_default="as recorded",
        ),
    ],
    "intrinsics": Annotated[
        tuple[float, float, float, float] | None,
        typer.Option(
            metavar="FX FY CX CY",
            help="Intrinsics of a recording's depth camera, in pixels.",
            show_default="those in its folder or the parent",
        ),
    ],
    "depth_scale": Annotated[
        float | None,
        typer.Option(
            help="The length of a unit of a recording's images in the units of its poses, 0.0002 for TUM RGB-D.",
            show_default="the usual one with which frames agree",
        ),
    ],
}
KNOWN_PARTS = {
    "parts": Annotated[
        Path | None,
        typer.Option(help="A folder of the parts' meshes, at true size.", show_default="sets of parts that look alike"),
    ],
    "setup": Annotated[
        Setup | None,
        typer.Option(
            help="How a part is scanned: all of it in view, a patch of it, on a table, or beside a box.",
            show_default="each",
        ),
    ],
}

PYRAMID = Entry(
    "jaxnbv.studies.classification.objects:PyramidStudy",
    "Which methods find the pattern on a pyramid's base, and how soon is its class known?",
    scenes=100,
    views=5,
    model="known",
    options=FRAMING | CLASSES,
)
TRUCK = Entry(
    "jaxnbv.studies.classification.objects:TruckStudy",
    "How soon is the class of a truck's cargo known, which most views do not show? The paper's Truck-ModelNet10, "
    "on procedural trucks and cargo, or on meshes: a folder `trucks`, and folders of the classes' names.",
    scenes=100,
    views=5,
    model="known",
    options=MESHES | CLASSES,
)
HOUSEHOLD = Entry(
    "jaxnbv.studies.classification.objects:HouseholdStudy",
    "Do all methods tell classes alike that differ in global shape? The paper's ModelNet10, on procedural objects, "
    "or on meshes in folders of the classes' names.",
    scenes=100,
    views=5,
    model="known",
    options=MESHES | CLASSES,
)
OMNIOBJECT3D = Entry(
    "jaxnbv.studies.classification.objects:OmniObject3DStudy",
    "How soon are fruits told that differ in what is small? The paper's OmniObject3D, on meshes of yours in "
    "folders of the classes' names, with a classifier of yours.",
    scenes=100,
    views=5,
    options=MESHES | CLASSES,
)
PARTS = Entry(
    "jaxnbv.studies.parts.study:PartStudy",
    "How many views until all parts of an object are found? The paper's Table 1, on procedural objects, or on "
    "meshes whose nodes are their parts, in folders of the classes' names.",
    scenes=80,
    views=6,
    model="known",
    options=MESHES,
)
HEAT = Entry(
    "jaxnbv.studies.heat:HeatStudy",
    "How near does the coldest point of the scanned cloud come to the object's? On procedural objects whose "
    "coldest point hides, or on your meshes, heated at one place.",
    scenes=24,
    views=6,
    model="known",
    options=MESHES,
)
RECONSTRUCTION = Entry(
    "jaxnbv.studies.reconstruction:ReconstructionStudy",
    "How near is the surface that a method's views give to the true one? The table of the paper's supplement.",
    scenes=32,
    views=5,
    options=MESHES,
)
RECORDED = Entry(
    "jaxnbv.studies.recorded:RecordedStudy",
    "Which frames of a recorded sequence show the most of a box? On a folder of 7-Scenes, of TUM RGB-D, or with a "
    "frames.json (see RecordedFrames).",
    scenes=6,
    views=6,
    options=RECORDING,
)
IDENTIFICATION = Entry(
    "jaxnbv.studies.identification:IdentificationStudy",
    "Which of some known parts is it, and how does it lie? On your own parts, or on sets of parts that look alike.",
    scenes=40,
    views=4,
    model="known",
    options=KNOWN_PARTS,
)
