"""Recorded sequences: three layouts of one small recording, broken ones, and independent counts of the study's
measures."""

import json

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

import jaxnbv as nbv
from jaxnbv.studies.engine.pictures import write_pictures
from jaxnbv.studies.engine.run import run_scene
from jaxnbv.studies.recorded import COVERAGE, EVEN, NEW_AREA, ORACLE, RecordedStudy

UNIT = 1000.0
INTRINSICS = np.array([[40.0, 0.0, 23.5], [0.0, 40.0, 17.5], [0.0, 0.0, 1.0]])
CAMERA = nbv.Camera.from_intrinsics(INTRINSICS, height=36, width=48)
COUNT = 9


def recorded():
    """A ball of 0.3 m at (1, 2, 0.5), seen from a half circle around it: depths in mm, and matrices in metres."""
    center, depths, matrices = np.array([1.0, 2.0, 0.5]), [], []
    for angle in np.linspace(0.0, np.pi, COUNT):
        eye = center + 1.2 * np.array([np.cos(angle), np.sin(angle), 0.3])
        pose = nbv.look_at(eye, center, up=(0.0, 0.0, 1.0))
        ball = nbv.SDFSurface(nbv.sdf.Sphere(0.3).translate(center.tolist()))
        scan = nbv.scan(ball, CAMERA, pose)
        depth = (np.asarray(scan.points, np.float64) - eye) @ np.asarray(pose.forward, np.float64)
        depths.append(np.where(scan.mask, np.round(UNIT * depth), 0).astype(np.uint16).reshape(36, 48))
        matrices.append(np.asarray(pose.to_matrix(), np.float64))
    return np.stack(depths), np.stack(matrices)


@pytest.fixture(scope="module")
def sequence():
    return recorded()


def save(path, depth):
    Image.fromarray(depth).save(path)


def seven_scenes(folder, depths, matrices):
    for index, (depth, matrix) in enumerate(zip(depths, matrices, strict=True)):
        hole = depth.copy()
        # The data set's own mark of a missing depth.
        hole[depth == 0] = 65535
        save(folder / f"frame-{index:06d}.depth.png", hole)
        np.savetxt(folder / f"frame-{index:06d}.pose.txt", matrix, delimiter="\t")


def tum(folder, depths, matrices):
    (folder / "depth").mkdir()
    images, track = ["# time file"], ["# time tx ty tz qx qy qz qw"]
    for index, (depth, matrix) in enumerate(zip(depths, matrices, strict=True)):
        time = 1305031102.16 + 0.03 * index
        save(folder / "depth" / f"{index}.png", 5 * depth)
        images.append(f"{time:.6f} depth/{index}.png")
        quaternion = Rotation.from_matrix(matrix[:3, :3]).as_quat()
        track.append(" ".join(f"{x:.9f}" for x in [time + 0.004, *matrix[:3, 3], *quaternion]))
    # This image has no pose.
    images.append("1305031109.000000 depth/0.png")
    (folder / "depth.txt").write_text("\n".join(images))
    (folder / "groundtruth.txt").write_text("\n".join(track))


def plain(folder, depths, matrices):
    frames = []
    for index, (depth, matrix) in enumerate(zip(depths, matrices, strict=True)):
        save(folder / f"{index}.png", depth)
        frames.append({"depth": f"{index}.png", "pose": matrix.tolist()})
    (folder / "frames.json").write_text(json.dumps({"frames": frames}))


LAYOUTS = (seven_scenes, tum, plain)


def known_sensor(layout, folder, sequence):
    """A folder that states its intrinsics."""
    layout(folder, *sequence)
    np.savetxt(folder / "camera-intrinsics.txt", INTRINSICS)


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


def points_of(z, intrinsics, matrix):
    """World coordinates of the pixels of a depth image in metres, by an independent pinhole."""
    row, column = np.nonzero(z)
    (fx, _, cx), (_, fy, cy), _ = intrinsics
    local = np.stack([(column - cx) / fx, (row - cy) / fy, np.ones(len(row))], axis=-1) * z[row, column, None]
    return local @ matrix[:3, :3].T + matrix[:3, 3]


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


LOW, HIGH = (0.6, 1.6, 0.3), (1.4, 2.4, 0.9)
VIEWS = 3
SMALL = {"num_samples": 2, "grid_resolution": 24, "capacity": 200}


def configured(folder, **options):
    settings = SMALL | {"box": (*LOW, *HIGH)} | options
    return RecordedStudy.configured("screened", VIEWS, quick=True, folder=folder, **settings)[""]


@pytest.fixture(scope="module")
def study(sequence, tmp_path_factory):
    folder = tmp_path_factory.mktemp("recording")
    known_sensor(plain, folder, sequence)
    return configured(folder)


def voxels_of(study, depth, matrix):
    """Voxels in the box that a depth image shows, from its pixels in float64."""
    world = points_of(depth / UNIT, INTRINSICS, matrix)
    inside = np.all((world > LOW) & (world < HIGH), axis=1)
    return {tuple(place) for place in np.floor(world[inside] / study.voxel).astype(int)}


def test_its_voxels_are_those_that_three_frames_have_seen(study, sequence):
    """From all pixels. By rounding, a few are in the next voxel."""
    voxels = [voxels_of(study, *frame) for frame in zip(*sequence, strict=True)]
    often = {place for place in set().union(*voxels) if sum(place in one for one in voxels) >= 3}
    is_shown = study.recording.is_shown
    assert is_shown.shape[1] == pytest.approx(len(often), rel=0.01)
    expected = [len(one & often) / len(often) for one in voxels]
    np.testing.assert_allclose(is_shown.mean(axis=1), expected, atol=0.01)
    assert (is_shown.sum(axis=0) >= 3).all()


def test_a_study_takes_intrinsics_and_unit(study, sequence, tmp_path):
    folder = tmp_path / "sequence"
    folder.mkdir()
    tum(folder, *sequence)
    same = configured(folder, intrinsics=(40.0, 40.0, 23.5, 17.5), depth_scale=1 / 5000)
    np.testing.assert_array_equal(same.recording.is_shown, study.recording.is_shown)


@pytest.fixture(scope="module")
def record(study):
    # The other methods have searches of all studies, and each compiles its own planner.
    return run_scene(study, 1, (NEW_AREA, "random", EVEN, ORACLE))


def test_every_method_is_measured_by_what_its_frames_show(study, record):
    acquisitions = {method: type(study.acquisition(method, study.scene(1))) for method in study.methods}
    assert acquisitions == dict.fromkeys(study.methods, nbv.NewSurface) | {COVERAGE: nbv.Coverage}
    first, is_shown = record["first"], study.recording.is_shown
    for name, method in record["methods"].items():
        frames = method["frames"]
        assert frames[0] == first, name
        assert len(set(frames)) == VIEWS
        expected = [is_shown[frames[: count + 1]].any(axis=0).mean() for count in range(VIEWS)]
        assert method["covered"] == pytest.approx(expected)
    assert record["methods"][EVEN]["frames"] == [(first + 3 * part) % COUNT for part in range(VIEWS)]
    gain = [is_shown[[first, other]].any(axis=0).sum() for other in range(COUNT)]
    best = record["methods"][ORACLE]
    assert gain[best["frames"][1]] == max(gain)
    assert all(method["covered"][1] <= best["covered"][1] for method in record["methods"].values())
    of_new = study.measures[1].compute(record, NEW_AREA)
    own = record["methods"][NEW_AREA]["covered"]
    assert of_new[3] == pytest.approx((own[2] - own[0]) / (best["covered"][2] - best["covered"][0]))


def test_its_pictures_show_every_method(study, record, tmp_path):
    (path,) = write_pictures([record], study, tmp_path, pixels=80)
    assert path.name == "scene_0001.png"
    pixels = np.asarray(Image.open(path).convert("RGB")).reshape(-1, 3)
    assert len(np.unique(pixels, axis=0)) > 20


def test_first_views_differ_and_show_enough(study):
    firsts = [study.first_view(study.scene(index)) for index in range(4)]
    assert len(set(firsts)) == 4
    assert all(study.recording.is_shown[first].mean() >= 0.05 for first in firsts)


def test_what_the_study_cannot_use_is_named(study, sequence, tmp_path):
    known_sensor(plain, tmp_path, sequence)
    with pytest.raises(ValueError, match="give one of the models screened, paper"):
        RecordedStudy.configured("known", VIEWS, quick=True, folder=tmp_path)
    with pytest.raises(ValueError, match="no voxel"):
        run_scene(configured(tmp_path, box=(9, 9, 9, 10, 10, 10)), 0)


def test_a_frame_that_looks_away_shows_nothing(sequence, tmp_path):
    depths, matrices = sequence
    back = np.diag([-1.0, 1.0, -1.0, 1.0])
    looks = np.concatenate([depths, depths[:1]]), np.concatenate([matrices, matrices[:1] @ back])
    known_sensor(plain, tmp_path, looks)
    counts = configured(tmp_path).recording.is_shown.sum(axis=1)
    assert counts[-1] == 0
    assert (counts[:-1] > 0).all()


def test_a_box_with_room_is_found_about_what_was_seen(sequence, tmp_path):
    known_sensor(plain, tmp_path, sequence)
    box = configured(tmp_path, box=None).box
    # The whole ball, except for the side that faces away from all cameras.
    np.testing.assert_allclose(box.high, [1.33, 2.33, 0.83], atol=0.03)
    np.testing.assert_allclose(box.low[:2], [0.67, 1.92], atol=0.15)
    assert (np.array(box.high) > [1.299, 2.299, 0.799]).all()
