"""`jaxnbv identify` on a recording of a known part, against the true pose."""

import dataclasses
import json

import numpy as np
import pytest
import trimesh
from PIL import Image

import jaxnbv as nbv
from jaxnbv.checks import InputError
from jaxnbv.cli.identify import identify, object_pose_text
from jaxnbv.cli.tasks.identification import bank_of
from jaxnbv.geometry.rotations import rotation_about
from jaxnbv.surfaces.part_pose import ObjectPose

CAMERA = nbv.Camera.from_intrinsics([[90.0, 0.0, 32.0], [0.0, 90.0, 24.0], [0.0, 0.0, 1.0]], width=64, height=48)
CENTRE, TURN = np.array([0.3, 0.2, 0.1]), np.asarray(rotation_about(np.array([1.0, 2.0, 0.5]), 0.8), np.float64)


def block(*sides, at=(0.0, 0.0, 0.0)):
    return trimesh.creation.box(sides, trimesh.transformations.translation_matrix(at))


ASKED = {"box": None, "intrinsics": None, "depth_scale": None}
# In millimetres.
PARTS = {
    "block": block(80, 50, 40),
    "bracket": trimesh.util.concatenate([block(80, 12, 50), block(14, 60, 50, at=(-33, 30, 0))]),
    "rod": trimesh.creation.cylinder(14, 90),
}


@pytest.fixture(scope="module")
def parts(tmp_path_factory):
    folder = tmp_path_factory.mktemp("parts")
    for name, mesh in PARTS.items():
        mesh.export(folder / f"{name}.ply")
    return folder


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """Four depth images of the bracket in millimetres, with poses in metres and z up."""
    folder, frames = tmp_path_factory.mktemp("recording"), []
    vertices = 0.001 * np.asarray(PARTS["bracket"].vertices) @ TURN.T + CENTRE
    mesh = nbv.TriangleMesh(vertices, np.asarray(PARTS["bracket"].faces), nbv.Frame())
    for index, direction in enumerate([(1, 0.2, 0.5), (0, 1, 0.6), (-1, 0.1, 0.4), (0.3, -1, 0.7)]):
        away = 0.3 * np.asarray(direction) / np.linalg.norm(direction)
        pose = nbv.look_at(CENTRE + away, CENTRE, up=(0.0, 0.0, 1.0))
        cloud = nbv.scan(mesh, CAMERA, pose)
        depth = (np.asarray(cloud.points) - np.asarray(pose.position)) @ np.asarray(pose.forward)
        image = np.where(cloud.mask, np.round(1000 * depth), 0).astype(np.uint16).reshape(48, 64)
        Image.fromarray(image).save(folder / f"{index}.png")
        frames.append({"depth": f"{index}.png", "pose": np.asarray(pose.to_matrix(), np.float64).tolist()})
    intrinsics = [[90.0, 0.0, 32.0], [0.0, 90.0, 24.0], [0.0, 0.0, 1.0]]
    text = json.dumps({"intrinsics": intrinsics, "depth_scale": 0.001, "frames": frames})
    (folder / "frames.json").write_text(text)
    return folder


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:no table is found")
def test_a_recorded_part_is_named_and_lies_where_it_does(parts, recording, tmp_path, capsys):
    box = (*(CENTRE - 0.08), *(CENTRE + 0.08))
    identify(recording=recording, parts=parts, parts_scale="mm", views=3, out=tmp_path, **ASKED | {"box": box})
    said = capsys.readouterr().out
    assert [line.split()[1] for line in said.splitlines() if line.startswith("frame")] == ["0", "2", "3"]
    assert "bracket" in next(line for line in said.splitlines() if "█" in line)
    assert " mm, " in said
    answer = json.loads((tmp_path / "identity.json").read_text())["object"]
    assert answer["name"] == "bracket"
    assert sum(answer["names"].values()) == pytest.approx(1.0, abs=1e-5)
    assert answer["names"]["bracket"] > 0.9
    vertices = 0.001 * PARTS["bracket"].vertices
    places = [vertices @ np.array(m)[:3, :3].T + np.array(m)[:3, 3] for m in answer["alternatives"]]
    away = [np.linalg.norm(place - (vertices @ TURN.T + CENTRE), axis=1).max() for place in places]
    assert min(away) < 0.004
    page = (tmp_path / "report.html").read_text()
    assert "Which part is it?" in page
    assert "likeliest part" in page


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:no table is found", "ignore:there is no table under")
def test_objects_that_masks_show_are_named_apart(parts, recording, tmp_path, capsys):
    """Only the bracket is masked, and not in every frame."""
    (tmp_path / "masks").mkdir()
    for index in (0, 2):
        pixels = np.asarray(Image.open(recording / f"{index}.png")) > 0
        Image.fromarray(255 * pixels.astype(np.uint8)).save(tmp_path / "masks" / f"{index}.it.png")
    options = ASKED | {"box": (*(CENTRE - 0.08), *(CENTRE + 0.08)), "masks": tmp_path / "masks"}
    identify(recording=recording, parts=parts, parts_scale="mm", views=4, out=tmp_path, **options)
    said = capsys.readouterr().out
    assert [line.split()[:3] for line in said.splitlines() if line.startswith("frame")] == [
        ["frame", "0", "it:"],
        ["frame", "1", "shows"],
        ["frame", "2", "it:"],
        ["frame", "3", "shows"],
    ]
    assert json.loads((tmp_path / "identity.json").read_text())["it"]["name"] == "bracket"
    assert (tmp_path / "it" / "report.html").exists()


def test_a_pose_is_printed_in_the_unit_of_the_world():
    """Deviations of three degrees about one axis, and of four thousandths along one."""
    deviations = np.array([0.01, np.radians(3.0), 0.0, 0.0, 0.004, 0.001])
    pose = ObjectPose("rod", np.eye(4), np.diag(deviations**2), np.eye(4)[None])
    assert "least certain axes: 4 mm, 3 degrees.\nNo other pose is as right." in object_pose_text(pose, "m")
    round_one = dataclasses.replace(pose, alternatives=np.tile(np.eye(4), (72, 1, 1)))
    assert "least certain axes: 0.004 world units, 3 degrees.\n72 poses are equally right" in object_pose_text(
        round_one, "world units"
    )


def test_a_cloud_is_no_recording(parts, tmp_path):
    (tmp_path / "scan.ply").write_text("ply")
    with pytest.raises(InputError, match=r"scan\.ply is a file: identify needs depth images with the poses"):
        identify(recording=tmp_path / "scan.ply", parts=parts, **ASKED)


@pytest.mark.parametrize("several", [False, True])
def test_a_box_that_no_frame_shows_is_refused(several, parts, recording):
    box = (*(CENTRE + 0.2), *(CENTRE + 0.3))
    with pytest.raises(InputError, match=r"none of the 4 frames of .* shows an object in the box: give --box"):
        identify(recording=recording, parts=parts, parts_scale="mm", several=several, **ASKED | {"box": box})


def test_parts_of_another_unit_are_refused(parts):
    assert bank_of(parts, "mm", 0.1).names == ("block", "bracket", "rod")
    assert bank_of(parts, "0.001", 0.1).is_true_size
    with pytest.raises(InputError, match=r"are 80 to 90 long, the object about 0\.1: give the parts' unit"):
        bank_of(parts, "m", 0.1)
    with pytest.raises(InputError, match="the unit is 'inch': give one of"):
        bank_of(parts, "inch", 0.1)
