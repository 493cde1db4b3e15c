"""The readers of ModelNet on tiny folders of its layout, whole, partial and damaged."""

import warnings

import numpy as np
import pytest

from jaxnbv.checks import InputError
from jaxnbv.geometry.frame import Frame
from jaxnbv.studies.readers import MODELNET10, MODELNET40, ModelNet, ModelNetPoints, local_copy

# A pyramid of base 1 x 2 whose apex is at 4 along z.
CORNERS = np.array([[0, 0, 0], [1, 0, 0], [1, 2, 0], [0, 2, 0], [0.5, 1, 4.0]])
FACES = "4 0 3 2 1\n3 0 1 4\n3 1 2 4\n3 2 3 4\n3 3 0 4\n"


def off(path, first="OFF\n"):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"{first}5 5 0\n" + "".join(f"{x} {y} {z}\n" for x, y, z in CORNERS) + FACES)


@pytest.fixture
def folder(tmp_path):
    """All meshes for tests of two classes, and two that are trained on."""
    for number in range(107, 157):
        off(tmp_path / "bathtub" / "test" / f"bathtub_{number:04d}.off")
    for number in range(201, 287):
        off(tmp_path / "night_stand" / "test" / f"night_stand_{number:04d}.off", "OFF")
    for number in (1, 200):
        off(tmp_path / "night_stand" / "train" / f"night_stand_{number:04d}.off")
    (tmp_path / "README.txt").write_text("of the data set")
    return tmp_path


def test_there_are_as_many_meshes_as_published(tmp_path, monkeypatch):
    """Wu et al.: 12,311 meshes of 40 classes, of which 9,843 for training; 4,899 and 3,991 of ten."""
    monkeypatch.setattr(local_copy, "is_file", lambda path: True)
    assert len(MODELNET40) == 40
    assert set(MODELNET10) < set(MODELNET40)
    for name in MODELNET40:
        (tmp_path / name.replace(" ", "_")).mkdir()
    meshes = {split: ModelNet(tmp_path, split) for split in ("train", "test")}
    assert (len(meshes["train"]), len(meshes["test"])) == (9843, 2468)
    assert meshes["train"].classes == MODELNET40
    assert [len(ModelNet(tmp_path, split, MODELNET10)) for split in ("train", "test")] == [3991, 908]
    # No mesh is in both.
    names = [{file.name for file in of.files} for of in meshes.values()]
    assert not names[0] & names[1]


def test_meshes_stand_upright_with_their_labels(folder):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        meshes = ModelNet(folder, "test", ["Night_Stand", "bathtub"])
    assert meshes.classes == ("night stand", "bathtub")
    assert len(meshes) == 86 + 50
    assert [meshes.files[index].name for index in (0, 85, 86)] == [
        "night_stand_0201",
        "night_stand_0286",
        "bathtub_0107",
    ]
    found = meshes[0]
    assert (found.label, found.name, meshes[-1].label) == (0, "night_stand_0201", 1)
    # 4 is the longest side, along z in the file; the apex is on top here.
    np.testing.assert_allclose(np.ptp(found.mesh.vertices, axis=0), [0.625, 2.5, 1.25])
    top = found.mesh.vertices[np.argmax(found.mesh.vertices[:, 1])]
    np.testing.assert_allclose(found.mesh.frame.to_world(top), CORNERS[4])
    with pytest.raises(IndexError):
        meshes[136]


def test_what_a_copy_lacks_is_named_by_path(folder):
    with pytest.warns(UserWarning, match=r"198 of the 200 meshes of .*night_stand_0002.off, .*_0004.off and 195 more"):
        meshes = ModelNet(str(folder), "train", "night stand")
    assert [file.name for file in meshes.files] == ["night_stand_0001", "night_stand_0200"]
    with pytest.raises(InputError, match=r"none of the 106 meshes of .*bathtub/train is there: .*bathtub_0001.off"):
        ModelNet(folder, "train", ["bathtub"])
    with pytest.raises(InputError, match="no folder for 8 of the 10 classes: bed, chair, desk and 5 more"):
        ModelNet(folder, "test")
    (folder / "xbox").mkdir()
    with pytest.raises(InputError, match="no folder for 37 of the 40 classes: airplane, bed, bench and 34 more"):
        ModelNet(folder, "test")


def test_splits_classes_and_folders_that_do_not_exist(folder):
    with pytest.raises(InputError, match=r"no folder .*nowhere"):
        ModelNet(folder / "nowhere", "test")
    with pytest.raises(InputError, match="no split 'validation': choose from train, test"):
        ModelNet(folder, "validation")
    with pytest.raises(InputError, match=r"no class \['fruit'\] in ModelNet: choose from airplane"):
        ModelNet(folder, "test", ["bathtub", "fruit"])
    with pytest.raises(InputError, match="no class is chosen"):
        ModelNet(folder, "test", [])


def test_a_damaged_mesh_is_named_when_it_is_read(folder):
    meshes = ModelNet(folder, "test", ["bathtub"])
    (folder / "bathtub" / "test" / "bathtub_0108.off").write_text("OFF\n5 5 0\n0 0")
    with pytest.raises(InputError, match=r"bathtub_0108\.off"):
        meshes[1]
    (folder / "bathtub" / "test" / "bathtub_0109.off").unlink()
    with pytest.raises(InputError, match=r"there is no file .*bathtub_0109\.off"):
        meshes[2]
    assert meshes[0].name == "bathtub_0107"


RNG = np.random.default_rng(0)
LISTS = {"train": ["tv_stand_0001", "bed_0001"], "test": ["bed_0516", "tv_stand_0268", "bed_0517"]}


def text(count=30):
    normals = RNG.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    rows = np.concatenate([RNG.uniform(-1, 1, (count, 3)), normals], axis=1)
    return "".join(",".join(f"{value:.6f}" for value in row) + "\n" for row in rows)


@pytest.fixture
def resampled(tmp_path):
    (tmp_path / "modelnet40_shape_names.txt").write_text("airplane\nbed\ntv_stand\n")
    (tmp_path / "modelnet10_shape_names.txt").write_text("bed\n")
    (tmp_path / "modelnet10_test.txt").write_text("bed_0516\nbed_0517\n")
    for split, names in LISTS.items():
        (tmp_path / f"modelnet40_{split}.txt").write_text("\n".join(names) + "\n")
        for name in names:
            of_class = tmp_path / name[:-5]
            of_class.mkdir(exist_ok=True)
            (of_class / f"{name}.txt").write_text(text())
    return tmp_path


def test_points_are_read_in_the_order_of_the_list(resampled):
    shapes = ModelNetPoints(resampled, "test")
    assert shapes.classes == ("airplane", "bed", "tv stand")
    assert [(shape.name, shape.label) for shape in shapes] == [("bed_0516", 1), ("tv_stand_0268", 2), ("bed_0517", 1)]
    written = np.loadtxt(resampled / "tv_stand" / "tv_stand_0268.txt", delimiter=",")
    np.testing.assert_array_equal(shapes[1].points, written[:, :3])
    np.testing.assert_array_equal(shapes[1].normals, written[:, 3:])
    assert len(ModelNetPoints(str(resampled), "train")) == 2
    ten = ModelNetPoints(resampled, "test", 10)
    assert (ten.classes, [shape.label for shape in ten]) == (("bed",), [0, 0])
    with pytest.raises(IndexError):
        shapes[3]


def test_normalised_points_and_clouds_keep_their_rows(resampled):
    shape = ModelNetPoints(resampled, "train")[0]
    normalised = shape.normalised()
    np.testing.assert_allclose(normalised.points.mean(axis=0), 0.0, atol=1e-12)
    assert np.linalg.norm(normalised.points, axis=1).max() == pytest.approx(1.0)
    cloud = normalised.to_cloud(Frame(1.25))
    np.testing.assert_allclose(cloud.points, 1.25 * normalised.points, atol=1e-6)
    np.testing.assert_allclose(cloud.normals, shape.normals, atol=1e-5)


def test_objects_that_the_list_names_and_the_folder_lacks(resampled):
    (resampled / "bed" / "bed_0516.txt").unlink()
    (resampled / "tv_stand" / "tv_stand_0268.txt").unlink()
    message = (
        r"2 of the 3 files that .*modelnet40_test.txt names are not there: .*bed_0516.txt, .*tv_stand_0268.txt; unp"
    )
    with pytest.raises(InputError, match=message):
        ModelNetPoints(resampled, "test")
    assert len(ModelNetPoints(resampled, "train")) == 2


@pytest.mark.parametrize(
    ("file", "content", "message"),
    [
        ("modelnet40_test.txt", None, "there is no file .*modelnet40_test.txt"),
        ("modelnet40_test.txt", "\n \n", "modelnet40_test.txt lists nothing"),
        ("modelnet40_test.txt", "bed_0516\nfruit_0001\n", "lists 'fruit_0001'; expected <class>_<number>"),
        ("modelnet40_test.txt", "bed\n", "lists 'bed'; expected"),
        ("modelnet40_test.txt", "bed_one\n", "lists 'bed_one'; expected"),
        ("modelnet40_shape_names.txt", None, "there is no file .*modelnet40_shape_names.txt"),
        ("modelnet40_shape_names.txt", "", "modelnet40_shape_names.txt lists nothing"),
    ],
)
def test_damaged_lists(resampled, file, content, message):
    if content is None:
        (resampled / file).unlink()
    else:
        (resampled / file).write_text(content)
    with pytest.raises(InputError, match=message):
        ModelNetPoints(resampled, "test")


def test_splits_and_numbers_of_classes_that_do_not_exist(resampled):
    with pytest.raises(InputError, match="no split 'val'"):
        ModelNetPoints(resampled, "val")
    with pytest.raises(InputError, match="no ModelNet of 20 classes: give 10 or 40"):
        ModelNetPoints(resampled, "test", 20)
    with pytest.raises(InputError, match="there is no folder"):
        ModelNetPoints(resampled / "nowhere", "test")


ROW = "0.1,0.2,0.3,1,0,0\n"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "there is no file .*bed_0516.txt"),
        ("", "bed_0516.txt is empty"),
        ("0.1,0.2,0.3\n", "has 3 columns; expected 6: x,y,z,nx,ny,nz"),
        (f"{ROW}0.1,0.2,0.3\n", "bed_0516.txt is damaged .*: each row must be x,y,z,nx,ny,nz"),
        ("0.1 0.2 0.3 1 0 0\n", "bed_0516.txt is damaged"),
        (f"{ROW}0.1,nan,0.3,1,0,0\n", r"bed_0516.txt has numbers that are not finite, the first in row \[1\]"),
        (f"{ROW}{ROW}0.1,0.2,0.3,0,0,0\n", r"bed_0516.txt has 1 normals of length zero, the first in row \[2\]"),
    ],
)
def test_damaged_points(resampled, content, message):
    shapes = ModelNetPoints(resampled, "test")
    file = resampled / "bed" / "bed_0516.txt"
    if content is None:
        file.unlink()
    else:
        file.write_text(content)
    with pytest.raises(InputError, match=message):
        shapes[0]
    assert shapes[2].name == "bed_0517"
