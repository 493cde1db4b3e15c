"""Recorded sequences: three layouts of one small recording, and broken ones."""

import json

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation
from small_recording import (
    COUNT,
    INTRINSICS,
    LAYOUTS,
    UNIT,
    known_sensor,
    plain,
    points_of,
    recorded,
    seven_scenes,
    tum,
)

import jaxnbv as nbv


@pytest.fixture(scope="module")
def sequence():
    return recorded()


FOUR = "40 40 23.5 17.5"
OPEN3D = {"width": 48, "height": 36, "intrinsic_matrix": INTRINSICS.T.reshape(-1).tolist()}
# Folders in which the intrinsics of the recording stand, or in the parent those of other sensors, which must not count.
STORED = {
    "3DMatch, in the parent": lambda folder: np.savetxt(folder.parent / "camera-intrinsics.txt", INTRINSICS),
    "in the folder before the parent": lambda folder: [
        np.savetxt(folder / "camera-intrinsics.txt", INTRINSICS),
        np.savetxt(folder.parent / "camera-intrinsics.txt", 2.0 * INTRINSICS),
    ],
    "ScanNet, depth beside colour": lambda folder: [
        np.savetxt(folder / "intrinsic_depth.txt", np.block([[INTRINSICS, np.zeros((3, 1))], [0, 0, 0, 1]])),
        np.savetxt(folder / "intrinsic_color.txt", np.eye(4)),
    ],
    "ETH3D": lambda folder: (folder / "calibration.txt").write_text(FOUR + "\n"),
    "BundleFusion": lambda folder: (folder / "info.txt").write_text(
        "m_versionNumber = 4\nm_calibrationDepthIntrinsic = 40 0 23.5 0 0 40 17.5 0 0 0 1 0 0 0 0 1\n"
    ),
    "Open3D": lambda folder: (folder / "camera_intrinsic.json").write_text(json.dumps(OPEN3D)),
    "by name": lambda folder: (folder / "intrinsics.json").write_text(
        json.dumps({"fx": 40, "fy": 40, "cx": 23.5, "cy": 17.5})
    ),
}


def check_points(frames, sequence):
    """Every frame's points lie on the ball."""
    for index, depth in enumerate(sequence[0]):
        z = frames.depth_scale * frames.depth(index)
        np.testing.assert_allclose(z, depth / UNIT, atol=1e-9)
        points = points_of(z, frames.camera.intrinsics, frames.matrices[index])
        off = np.abs(np.linalg.norm(points - [1.0, 2.0, 0.5], axis=1) - 0.3)
        assert np.median(off) < 0.5e-3


# Each place once, with one layout after the other. Reading intrinsics does not depend on the layout.
@pytest.mark.parametrize(("layout", "place"), [*zip(3 * LAYOUTS, STORED, strict=False)])
def test_each_layout_takes_the_intrinsics_that_lie_there_and_the_unit_that_fits(layout, place, sequence, tmp_path):
    folder = tmp_path / "sequence" / "seq-01"
    folder.mkdir(parents=True)
    layout(folder, *sequence)
    with pytest.raises(ValueError, match=r"give intrinsics=\(fx, fy, cx, cy\).*--intrinsics.*585.*535\.4.*481\.2"):
        nbv.readers.RecordedFrames(folder)
    STORED[place](folder)
    frames = nbv.readers.RecordedFrames(folder)
    assert len(frames) == COUNT
    np.testing.assert_allclose(frames.matrices, sequence[1], atol=1e-6)
    np.testing.assert_allclose(frames.camera.intrinsics, INTRINSICS)
    check_points(frames, sequence)


@pytest.mark.parametrize(
    ("layout", "given"), [(seven_scenes, INTRINSICS), (tum, INTRINSICS.tolist()), (plain, (40.0, 40.0, 23.5, 17.5))]
)
def test_arguments_take_precedence_over_files(layout, given, sequence, tmp_path):
    layout(tmp_path, *sequence)
    np.savetxt(tmp_path / "camera-intrinsics.txt", 2.0 * INTRINSICS)
    scale = 1 / 5000 if layout is tum else 1e-3
    check_points(nbv.readers.RecordedFrames(tmp_path, intrinsics=given, depth_scale=scale), sequence)


@pytest.mark.parametrize("units", [1, 4, 5, 10])
def test_the_unit_is_the_one_with_which_frames_agree(units, sequence, tmp_path):
    """Thousands for a metre."""
    depths, matrices = sequence
    plain(tmp_path, depths * units, matrices)
    frames = nbv.readers.RecordedFrames(tmp_path, intrinsics=INTRINSICS)
    assert 1.0 / frames.depth_scale == pytest.approx(1000 * units)


def test_an_undetermined_unit_must_be_given(sequence, tmp_path):
    """One frame, and a camera that does not move, agree with themselves in any unit."""
    depths, matrices = sequence
    for name, still in (("one", slice(0, 1)), ("still", [0, 0, 0])):
        (tmp_path / name).mkdir()
        known_sensor(seven_scenes, tmp_path / name, (depths[still], matrices[still]))
        with pytest.raises(ValueError, match=r"give depth_scale=.*1/1000.*1/5000.*1/10000"):
            nbv.readers.RecordedFrames(tmp_path / name)
        frames = nbv.readers.RecordedFrames(tmp_path / name, depth_scale=1e-3)
        assert frames.depth_scale == pytest.approx(1e-3)


LOST = {
    "-inf": np.full((4, 4), -np.inf),
    "nan": np.full((4, 4), np.nan),
    "zeros": np.zeros((4, 4)),
    "no rotation": np.diag([0.0, 0.0, 0.0, 1.0]),
    "ones": np.ones((4, 4)),
    "a reflection": np.diag([1.0, 1.0, -1.0, 1.0]),
}


@pytest.mark.parametrize(("name", "layout"), [*zip(LOST, [seven_scenes, plain] * 3, strict=True)])
def test_a_frame_whose_pose_was_lost_is_left_out(name, layout, sequence, tmp_path):
    depths, matrices = sequence
    poses = matrices.copy()
    poses[3] = LOST[name]
    known_sensor(layout, tmp_path, (depths, poses))
    with pytest.warns(UserWarning, match=r"1 of the 9 poses .*3.*left out") as warned:
        frames = nbv.readers.RecordedFrames(tmp_path)
    assert len(warned) == 1
    has_pose = np.arange(COUNT) != 3
    np.testing.assert_allclose(frames.matrices, matrices[has_pose], atol=1e-6)
    check_points(frames, (depths[has_pose], None))


@pytest.mark.parametrize("lost", [" ".join(7 * ["nan"]), "0 0 0 0 0 0 0", "-1.#IND 0 0 0 0 0 1", "0 0 0 0 0 0 inf"])
def test_a_lost_row_of_a_track_is_left_out(lost, sequence, tmp_path):
    known_sensor(tum, tmp_path, sequence)
    lines = (tmp_path / "groundtruth.txt").read_text().splitlines()
    lines[4] = f"{lines[4].split()[0]} {lost}"
    (tmp_path / "groundtruth.txt").write_text("\n".join(lines))
    with pytest.warns(UserWarning, match=r"1 of the 9 poses .*3\.png.*left out"):
        frames = nbv.readers.RecordedFrames(tmp_path)
    check_points(frames, (np.delete(sequence[0], 3, axis=0), None))


@pytest.mark.parametrize("layout", LAYOUTS)
def test_poses_to_three_digits_are_rotations(layout, sequence, tmp_path):
    """To within rounding, and exactly orthonormal."""
    depths, matrices = sequence
    known_sensor(layout, tmp_path, (depths, np.round(matrices, 3)))
    frames = nbv.readers.RecordedFrames(tmp_path)
    np.testing.assert_allclose(frames.matrices, matrices, atol=1e-3)
    nbv.Pose.from_matrix(frames.matrices)


ENCODED = {
    "BOM": lambda text: text.encode("utf-8-sig"),
    "UTF-16": lambda text: text.encode("utf-16"),
    "UTF-16 without BOM": lambda text: text.encode("utf-16-le"),
    "Windows, blank lines": lambda text: ("\r\n".join(["", *text.splitlines(), "  ", "\t", ""])).encode(),
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_text_of_any_editor_is_read(layout, sequence, tmp_path):
    known_sensor(layout, tmp_path, sequence)
    texts = {file: file.read_text() for file in (*tmp_path.glob("*.txt"), *tmp_path.glob("*.json"))}
    for encoding in ENCODED.values():
        for file, text in texts.items():
            file.write_bytes(encoding(text))
        frames = nbv.readers.RecordedFrames(tmp_path)
        np.testing.assert_allclose(frames.matrices, sequence[1], atol=1e-6)
        np.testing.assert_allclose(frames.camera.intrinsics, INTRINSICS)


def test_a_world_is_turned_upright(sequence, tmp_path):
    depths, matrices = sequence
    tilt = Rotation.from_euler("xyz", [0.4, -0.7, 1.1]).as_matrix()
    turned = matrices.copy()
    turned[:, :3, :] = tilt @ matrices[:, :3, :]
    known_sensor(plain, tmp_path, (depths, turned))
    frames = nbv.readers.RecordedFrames(tmp_path, up=tuple((3.0 * tilt[:, 2]).tolist()))
    # Heights and all distances are those before the world was tilted.
    np.testing.assert_allclose(frames.matrices[:, 2, 3], matrices[:, 2, 3], atol=1e-9)
    steps = [np.diff(m[:, :3, 3], axis=0) for m in (frames.matrices, matrices)]
    np.testing.assert_allclose(*(np.linalg.norm(step, axis=1) for step in steps), atol=1e-9)
    assert frames.matrices[0, :3, :3].T @ frames.matrices[0, :3, :3] == pytest.approx(np.eye(3), abs=1e-6)


def rewritten(file, change):
    """Change the text of a file."""
    return lambda folder: (folder / file).write_text(change((folder / file).read_text()))


def said(change):
    """Change the object in frames.json."""
    return rewritten("frames.json", lambda text: json.dumps(json.loads(text) | change))


def cut(folder):
    image = folder / "frame-000000.depth.png"
    image.write_bytes(image.read_bytes()[:60])


def coloured(folder):
    Image.new("RGB", (48, 36)).save(folder / "frame-000000.depth.png")


def doubled(folder):
    """Make the matrices similarities."""
    content = json.loads((folder / "frames.json").read_text())
    for frame in content["frames"]:
        frame["pose"] = (np.diag([2.0, 2.0, 2.0, 1.0]) @ frame["pose"]).tolist()
    (folder / "frames.json").write_text(json.dumps(content))


# A layout, a change of it, and words of the error.
BROKEN = {
    "empty": (lambda *_: None, lambda folder: None, "holds no recorded sequence"),
    "other times": (tum, rewritten("depth.txt", lambda _: "17.0 depth/0.png"), "no image has a pose within"),
    "no times": (tum, rewritten("depth.txt", lambda _: "depth/0.png"), "could not convert string to float"),
    "no image": (tum, lambda folder: (folder / "depth" / "1.png").unlink(), r"1 of the 9 files .*1\.png"),
    "no scale": (plain, said({"depth_scale": -1.0}), r"depth scale is -1\.0"),
    "units a metre": (plain, said({"depth_scale": 5000}), "5000.0, which is no length of a unit: .*1/5000"),
    "no frames": (plain, said({"frames": []}), "need at least one array"),
    "half a text": (plain, rewritten("frames.json", lambda text: text[:-9]), "JSONDecodeError"),
    "no pose": (seven_scenes, lambda f: (f / "frame-000003.pose.txt").unlink(), r"is not whole .*000003\.pose"),
    "inverse scale of poses": (plain, doubled, "9 of the 9 poses .* no rigid motion"),
    "other intrinsics": (plain, said({"intrinsics": [1, 2]}), r"intrinsics is \[1, 2\]: give a 3 x 3 matrix"),
    "intrinsics of text": (plain, lambda f: (f / "camera-intrinsics.txt").write_text("fx 40"), "no table of numbers"),
    "half an image": (seven_scenes, cut, "cannot read the depth image"),
    "an image of colours": (seven_scenes, coloured, "one channel of 16 bit"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_what_is_broken_is_named(name, sequence, tmp_path):
    layout, harm, message = BROKEN[name]
    known_sensor(layout, tmp_path, sequence)
    harm(tmp_path)
    with pytest.raises(ValueError, match=message):
        nbv.readers.RecordedFrames(tmp_path)


def test_missing_frames_and_a_wrong_up_are_named(sequence, tmp_path):
    known_sensor(plain, tmp_path, sequence)
    with pytest.raises(ValueError, match="no frame 9"):
        nbv.readers.RecordedFrames(tmp_path).depth(COUNT)
    with pytest.raises(ValueError, match="give a direction"):
        nbv.readers.RecordedFrames(tmp_path, up=(0.0, 0.0, 0.0))
