"""The reader of ShapeNet-part on a tiny folder, whole and damaged."""

import json

import numpy as np
import pytest

from jaxnbv.checks import InputError
from jaxnbv.geometry.frame import Frame
from jaxnbv.studies.readers import ShapeNetPart, unit_sphere

RNG = np.random.default_rng(0)
SYNSETS = {"Airplane": "02691156", "Chair": "03001627"}
LISTS = {
    "train": ["shape_data/02691156/a", "shape_data/03001627/b", "shape_data/02691156/c"],
    "val": ["shape_data/03001627/d"],
    "test": ["shape_data/03001627/e", "shape_data/02691156/f"],
}


def rows_of(synset, count=20):
    labels = RNG.integers(*((0, 4) if synset == "02691156" else (12, 16)), (count, 1))
    normals = RNG.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return np.concatenate([RNG.normal(size=(count, 3)) + 2, normals, labels], axis=1)


def text_of(rows):
    return "\n".join(" ".join(f"{value:.6f}" for value in row) for row in rows)


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "synsetoffset2category.txt").write_text("".join(f"{a}\t{b}\n" for a, b in SYNSETS.items()))
    (tmp_path / "train_test_split").mkdir()
    for synset in SYNSETS.values():
        (tmp_path / synset).mkdir()
    for split, lines in LISTS.items():
        (tmp_path / "train_test_split" / f"shuffled_{split}_file_list.json").write_text(json.dumps(lines))
        for line in lines:
            _, synset, name = line.split("/")
            (tmp_path / synset / f"{name}.txt").write_text(text_of(rows_of(synset)) + "\n")
    return tmp_path


def test_shapes_are_read_in_the_order_of_the_list(folder):
    shapes = ShapeNetPart(folder, "train")
    assert len(shapes) == 3
    assert [(shape.name, shape.category) for shape in shapes] == [("a", 0), ("b", 4), ("c", 0)]
    written = np.loadtxt(folder / "03001627" / "b.txt")
    np.testing.assert_array_equal(shapes[1].points, written[:, :3])
    np.testing.assert_array_equal(shapes[1].normals, written[:, 3:6])
    np.testing.assert_array_equal(shapes[1].labels, written[:, 6])
    assert shapes[1].labels.dtype == np.int64
    assert shapes[-1].name == "c"
    with pytest.raises(IndexError):
        shapes[3]
    assert [shape.name for shape in ShapeNetPart(str(folder), "validation")] == ["d"]
    assert [shape.name for shape in ShapeNetPart(folder, "test", ["chair"])] == ["e"]
    assert [shape.name for shape in ShapeNetPart(folder, "test", ["Chair", "airplane"])] == ["e", "f"]


def test_normalised_shapes_and_clouds_keep_their_rows(folder):
    shape = ShapeNetPart(folder, "test")[0]
    normalised = shape.normalised()
    np.testing.assert_allclose(normalised.points.mean(axis=0), 0.0, atol=1e-12)
    assert np.linalg.norm(normalised.points, axis=1).max() == pytest.approx(1.0)
    ratio = (shape.points - shape.points.mean(axis=0)) / normalised.points
    np.testing.assert_allclose(ratio, ratio[0, 0])
    np.testing.assert_array_equal(normalised.labels, shape.labels)
    cloud = normalised.to_cloud(Frame(1.25))
    np.testing.assert_allclose(cloud.points, 1.25 * normalised.points, atol=1e-6)
    np.testing.assert_allclose(cloud.normals, shape.normals, atol=1e-5)
    assert bool(cloud.mask.all())


def test_points_without_extent_cannot_be_normalised():
    with pytest.raises(InputError, match="give points that differ"):
        unit_sphere(np.ones((4, 3)))
    with pytest.raises(InputError, match="no points"):
        unit_sphere(np.ones((0, 3)))


def test_splits_and_categories_that_are_not_there(folder):
    with pytest.raises(InputError, match="there is no folder"):
        ShapeNetPart(folder / "nowhere", "train")
    with pytest.raises(InputError, match=r"no split 'trainval'.*validation"):
        ShapeNetPart(folder, "trainval")
    with pytest.raises(InputError, match="no category 'sofa'"):
        ShapeNetPart(folder, "train", ["sofa"])
    with pytest.raises(InputError, match=r"does not list \['lamp'\]"):
        ShapeNetPart(folder, "train", ["chair", "lamp"])
    with pytest.raises(InputError, match="lists no shape of these categories"):
        ShapeNetPart(folder, "validation", ["airplane"])


LIST = "train_test_split/shuffled_train_file_list.json"
TABLE = "synsetoffset2category.txt"


@pytest.mark.parametrize(
    ("file", "content", "message"),
    [
        (TABLE, None, "there is no file .*synsetoffset2category"),
        (TABLE, b"", "lists no category"),
        (TABLE, b"Airplane\n", "has the line 'Airplane'"),
        (TABLE, b"Sofa\t123\n", "no category 'Sofa'"),
        (TABLE, b"Airplane\t02691156\n", r"lists 'shape_data/03001627/b'"),
        (TABLE, b"\xff\xfe\x00", "cannot read"),
        (LIST, None, "there is no file .*train_file_list"),
        (LIST, b'["shape_data/02691156/a", ', "train_file_list.json is damaged"),
        (LIST, b'{"a": 1}', "holds no list"),
        (LIST, b'["shape_data/02691156/a", 3]', "lists 3; expected shape_data"),
        (LIST, b'["02691156/a"]', "lists '02691156/a'; expected"),
    ],
)
def test_damaged_folders(folder, file, content, message):
    if content is None:
        (folder / file).unlink()
    else:
        (folder / file).write_bytes(content)
    with pytest.raises(InputError, match=message):
        ShapeNetPart(folder, "train")


def test_shapes_that_the_list_names_and_the_folder_lacks(folder):
    (folder / "02691156" / "c.txt").unlink()
    with pytest.raises(
        InputError, match=r"1 of the 3 files that .*train_file_list.json names are not there: .*156/c.txt"
    ):
        ShapeNetPart(folder, "train")
    assert len(ShapeNetPart(folder, "train", ["chair"])) == 1


ROW = "0.1 0.2 0.3 1 0 0 "


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "there is no file .*a.txt"),
        ("", "a.txt is empty"),
        ("\n \n", "a.txt is empty"),
        ("0.1 0.2 0.3 1.0 0.0 0.0\n", "has 6 columns; expected 7"),
        (f"{ROW}1\n0.1 0.2 0.3\n", "a.txt is damaged"),
        (f"{ROW}one\n", "a.txt is damaged"),
        (f"{ROW}1\nnan 0.2 0.3 1 0 0 1\n", r"not finite, the first in row \[1\]"),
        (f"{ROW}1\n{ROW}12\n", r"label \[12.\] in row \[1\]; the parts of the category airplane are 0 to 3"),
        (f"{ROW}-1\n", r"label \[-1.\]"),
        (f"{ROW}50\n", r"label \[50.\]"),
        (f"{ROW}1.5\n", r"label \[1.5\]"),
    ],
)
def test_damaged_shapes(folder, content, message):
    shapes = ShapeNetPart(folder, "train")
    file = folder / "02691156" / "a.txt"
    if content is None:
        file.unlink()
    else:
        file.write_text(content)
    with pytest.raises(InputError, match=message):
        shapes[0]
    assert shapes[1].name == "b"
