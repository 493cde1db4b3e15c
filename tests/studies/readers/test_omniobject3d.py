"""The readers of OmniObject3D on tiny folders of its layout, whole, partial and damaged."""

import warnings

import numpy as np
import pytest
import trimesh

from jaxnbv.checks import InputError
from jaxnbv.geometry.frame import Frame
from jaxnbv.studies.readers import OmniObject3D, OmniObject3DPoints

NAMES = ("apple_004", "apple_001", "toy_truck_002")
RNG = np.random.default_rng(0)
POINTS = RNG.uniform(20.0, 90.0, (1024, 3))


def of_class(folder, name):
    path = folder / name[:-4] / name
    path.mkdir(parents=True, exist_ok=True)
    return path


@pytest.fixture
def folder(tmp_path):
    for name in NAMES:
        scan = of_class(tmp_path / "raw_scans", name) / "Scan"
        scan.mkdir()
        trimesh.creation.box((60.0, 90.0, 30.0)).export(scan / "Scan.obj")
        (scan / "Scan.mtl").write_text("newmtl material\n")
        (scan / "Scan.jpg").write_bytes(b"no picture")
        cloud = trimesh.PointCloud(POINTS.astype(np.float32))
        cloud.export(
            of_class(tmp_path / "point_clouds" / "ply_files" / "1024", name) / "pcd_1024.ply", encoding="ascii"
        )
    return tmp_path


def test_scans_of_all_classes_or_some(folder):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        scans = OmniObject3D(folder)
        inner = OmniObject3D(str(folder / "raw_scans"), ("toy truck", "Apple"))
    assert scans.classes == ("apple", "toy truck")
    expected = [("apple_001", 0), ("apple_004", 0), ("toy_truck_002", 1)]
    assert [(scan.name, scan.label) for scan in scans] == expected
    assert [(file.name, file.label) for file in inner.files] == [
        ("toy_truck_002", 0),
        ("apple_001", 1),
        ("apple_004", 1),
    ]
    assert len(OmniObject3D(folder, "apple")) == 2
    # Millimetres, and y upward.
    np.testing.assert_allclose(np.ptp(scans[0].mesh.vertices, axis=0), [2.5 * 60 / 90, 2.5, 2.5 * 30 / 90])
    assert scans[0].mesh.frame.scale == pytest.approx(2.5 / 90)


def test_what_a_copy_of_the_scans_lacks_is_named_by_path(folder):
    lost = folder / "raw_scans" / "apple" / "apple_004" / "Scan" / "Scan.obj"
    lost.unlink()
    with pytest.warns(UserWarning, match=f"1 of the 2 scans of .*apple are not there and are left out: {lost};"):
        scans = OmniObject3D(folder, ["apple"])
    assert [scan.name for scan in scans] == ["apple_001"]
    (folder / "raw_scans" / "apple" / "apple_001" / "Scan" / "Scan.obj").unlink()
    with pytest.raises(InputError, match=r"none of the 2 scans of .*apple is there: .*apple_001/Scan/Scan.obj, "):
        OmniObject3D(folder, ["apple"])
    with pytest.raises(InputError, match="no folder for 2 of the 3 classes: lemon, red_mango; unpack"):
        OmniObject3D(folder, ["lemon", "toy truck", "red mango"])
    with pytest.raises(InputError, match="there is no folder"):
        OmniObject3D(folder / "nowhere")
    with pytest.raises(InputError, match="no class is chosen"):
        OmniObject3D(folder, [])


def test_a_damaged_scan_is_named_when_it_is_read(folder):
    scans = OmniObject3D(folder, "apple")
    (folder / "raw_scans" / "apple" / "apple_001" / "Scan" / "Scan.obj").write_text("v 1 2 3\n")
    with pytest.raises(InputError, match=r"apple_001/Scan/Scan\.obj"):
        scans[0]
    assert scans[1].name == "apple_004"


def test_points_come_without_normals(folder):
    shapes = OmniObject3DPoints(folder)
    assert (shapes.classes, len(shapes)) == (("apple", "toy truck"), 3)
    assert [(shape.name, shape.label) for shape in shapes] == [("apple_001", 0), ("apple_004", 0), ("toy_truck_002", 1)]
    np.testing.assert_allclose(shapes[2].points, POINTS, rtol=1e-5)
    normalised = shapes[0].normalised()
    assert np.linalg.norm(normalised.points, axis=1).max() == pytest.approx(1.0)
    with pytest.raises(InputError, match="apple_001 has points without normals"):
        normalised.to_cloud(Frame())
    with pytest.raises(IndexError):
        shapes[3]


def test_what_a_copy_of_the_points_lacks_is_named_by_path(folder):
    with pytest.raises(InputError, match=r"there is no folder .*4096"):
        OmniObject3DPoints(folder, 4096)
    with pytest.raises(InputError, match="no folder for 1 of the 1 classes: lemon"):
        OmniObject3DPoints(folder, classes="lemon")
    of_points = folder / "point_clouds" / "ply_files" / "1024"
    (of_points / "apple" / "apple_001" / "pcd_1024.ply").unlink()
    with pytest.warns(UserWarning, match=r"1 of the 2 clouds of .*apple_001/pcd_1024.ply"):
        assert len(OmniObject3DPoints(folder, classes=["apple"])) == 1


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "there is no file .*pcd_1024.ply"),
        (b"", "cannot read .*pcd_1024.ply .*unpack it again"),
        (b"ply\nformat ascii 1.0\nelement vertex 1024\nproperty float x\n", "pcd_1024.ply"),
        (1000, "pcd_1024.ply is damaged: expected 1024 points"),
        (np.nan, "pcd_1024.ply is damaged: expected 1024 points of finite coordinates"),
    ],
)
def test_damaged_points(folder, content, message):
    shapes = OmniObject3DPoints(folder, classes=["apple"])
    file = folder / "point_clouds" / "ply_files" / "1024" / "apple" / "apple_001" / "pcd_1024.ply"
    if content is None:
        file.unlink()
    elif isinstance(content, bytes):
        file.write_bytes(content)
    else:
        points = POINTS[:1000] if content == 1000 else np.concatenate([POINTS[1:], [[content, 1, 1]]])
        file.write_bytes(trimesh.PointCloud(points).export(file_type="ply", encoding="ascii"))
    with pytest.raises(InputError, match=message):
        shapes[0]
    assert shapes[1].name == "apple_004"
