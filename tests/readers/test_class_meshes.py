"""Folders of meshes by class, as tiny copies of data sets, complete, partial and damaged."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from jaxnbv.checks import InputError
from jaxnbv.readers import class_meshes
from jaxnbv.studies.scenes import HOUSEHOLD


def box_files(folder, *names):
    """Write boxes of sides 1, 0.5 and 0.25."""
    for name in names:
        file = folder / name
        file.parent.mkdir(parents=True, exist_ok=True)
        trimesh.creation.box((1.0, 0.5, 0.25)).export(file)


def found_in(folder, classes):
    files = class_meshes(folder, classes)
    return files, [(classes[file.label], file.name) for file in files]


def test_meshes_of_classes_take_turns_and_other_folders_are_passed_over(tmp_path):
    """In ModelNet's layout, with `test` and underscores, and at any depth."""
    box_files(tmp_path, "bench/a.obj", "chair/b.obj", "chair/a.ply", "chair/deep/er/c.stl")
    box_files(tmp_path, "Night_Stand/train/a.off", "Night_Stand/test/c.off")
    (tmp_path / "chair" / "readme.txt").write_text("no mesh")
    names = [(HOUSEHOLD[mesh.label], Path(mesh.path).name) for mesh in class_meshes(tmp_path, HOUSEHOLD)]
    assert names == [("chair", "a.ply"), ("night stand", "c.off"), ("chair", "b.obj"), ("chair", "c.stl")]


def test_copies_of_modelnet_are_turned_upright(tmp_path):
    box_files(tmp_path / "bathtub", "test/bathtub_0107.off", "test/bathtub_0108.off", "train/bathtub_0001.off")
    box_files(tmp_path, "night_stand/test/night_stand_0201.off", "chair/y_up.off")
    (tmp_path / "README.txt").write_text("of the data set")
    files, names = found_in(tmp_path, HOUSEHOLD)
    bathtubs = [("bathtub", "bathtub_0107"), ("bathtub", "bathtub_0108")]
    assert names == [bathtubs[0], ("chair", "y_up"), ("night stand", "night_stand_0201"), bathtubs[1]]
    for file, sides in ((files[0], [2.5, 0.625, 1.25]), (files[1], [2.5, 1.25, 0.625])):
        np.testing.assert_allclose(np.ptp(file.read().vertices, axis=0), sides)


def test_copies_of_omniobject3d_name_objects_by_their_folder(tmp_path):
    names = ("apple/apple_003", "apple/apple_001", "toy_car/toy_car_001", "orange/orange_010")
    box_files(tmp_path / "raw_scans", *(f"{name}/Scan/Scan.obj" for name in names))
    (tmp_path / "point_clouds").mkdir()
    for folder in (tmp_path, tmp_path / "raw_scans"):
        files = found_in(folder, ["apple", "lemon", "orange"])[1]
        assert files == [("apple", "apple_001"), ("orange", "orange_010"), ("apple", "apple_003")]


@pytest.mark.parametrize("form", ["model.obj", "models/model_normalized.obj"], ids=["v1", "v2"])
def test_copies_of_shapenet_go_by_name_or_number(tmp_path, form):
    box_files(tmp_path, *(f"02958343/{name}/{form}" for name in "cab"), f"03001627/d/{form}")
    (tmp_path / "taxonomy.json").write_text("[]")
    assert found_in(tmp_path, ["chair", "car"])[1] == [("chair", "d"), ("car", "a"), ("car", "b"), ("car", "c")]
    assert found_in(tmp_path, ["02958343"])[1] == [("02958343", name) for name in "abc"]


def test_folders_without_a_class_or_a_mesh_are_refused(tmp_path):
    with pytest.raises(InputError, match="no folder"):
        class_meshes(tmp_path / "none", HOUSEHOLD)
    with pytest.raises(InputError, match="none of the folders bathtub, bed, chair"):
        class_meshes(tmp_path, HOUSEHOLD)
    (tmp_path / "sofa" / "test").mkdir(parents=True)
    with pytest.raises(InputError, match="sofa holds no mesh"):
        class_meshes(tmp_path, HOUSEHOLD)


def test_a_damaged_mesh_is_named_when_it_is_read(tmp_path):
    box_files(tmp_path, "bed/a.off", "bed/b.off", "bed/c.off")
    files = class_meshes(tmp_path, HOUSEHOLD)
    (tmp_path / "bed" / "b.off").write_text("OFF\n5 5 0\n0 0")
    (tmp_path / "bed" / "c.off").unlink()
    assert files[0].read().faces.shape == (12, 3)
    with pytest.raises(InputError, match=r"b\.off"):
        files[1].read()
    with pytest.raises(InputError, match="no mesh file at"):
        files[2].read()
