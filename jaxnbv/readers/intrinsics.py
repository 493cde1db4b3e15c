"""Reads the intrinsics of a recording's depth camera from an argument or from a file of a common format."""

import json
from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxnbv.checks import AnyArray, InputError, as_numbers, require, short_text
from jaxnbv.readers.text_files import read_rows, read_table, read_text

# Patterns of the files, first choice first: intrinsics of a depth camera are preferred to those of a colour camera.
_FILES = ("*depth*intrinsic*", "*intrinsic*depth*", "*camera*intrinsic*", "*intrinsic*", "calibration.txt", "info.txt")
_BUNDLE_FUSION = "m_calibrationDepthIntrinsic"


def intrinsic_matrix(values: Float[AnyArray, "..."] | list | tuple, name: str) -> Float[np.ndarray, "3 3"]:
    """Return the 3 x 3 matrix of intrinsics in pixels, given a 3 x 3 or 4 x 4 matrix, or fx, fy, cx, cy.

    **Raises:** `ValueError` if `values` have none of these shapes. The message calls them `name`.
    """
    array = np.squeeze(as_numbers(values, name, np.float64))
    if array.shape == (4,):
        fx, fy, cx, cy = array
        return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    require(array.shape in ((3, 3), (4, 4)), f"{name} is {short_text(values)}: give a 3 x 3 matrix, or fx, fy, cx, cy")
    return array[:3, :3]


def stored_intrinsics(folder: Path) -> Float[np.ndarray, "3 3"] | None:
    """Read the 3 x 3 matrix of intrinsics from a .txt or .json file in a folder or its parent.

    Returns None if there is no such file. A file in the folder is preferred to a file in the parent. A text file holds
    a 3 x 3 or 4 x 4 matrix, or fx, fy, cx, cy, or is BundleFusion's `info.txt`. A JSON file has Open3D's format, or the
    keys fx, fy, cx and cy, or holds only the matrix.

    **Raises:** `ValueError` if the file has none of these formats.
    """
    for directory in (folder, folder.resolve().parent):
        for pattern in _FILES:
            for file in sorted(directory.glob(pattern)):
                if file.suffix.lower() in (".txt", ".json") and file.is_file():
                    return _read_file(file)
    return None


def _read_file(file: Path) -> Float[np.ndarray, "3 3"]:
    if file.name == "info.txt":
        fields = {row[0]: row[2:] for row in read_rows(file)}
        require(_BUNDLE_FUSION in fields, f"{file} names no {_BUNDLE_FUSION}: give intrinsics=(fx, fy, cx, cy)")
        return intrinsic_matrix(np.reshape([float(word) for word in fields[_BUNDLE_FUSION]], (4, 4)), str(file))
    if file.suffix.lower() == ".txt":
        return intrinsic_matrix(read_table(file), str(file))
    try:
        content = json.loads(read_text(file))
    except ValueError as error:
        raise InputError(f"{file} is no JSON file: {error}") from error
    if not isinstance(content, dict):
        return intrinsic_matrix(content, str(file))
    if "intrinsic_matrix" in content:
        # Open3D writes the matrix column by column.
        return intrinsic_matrix(np.reshape(content["intrinsic_matrix"], (3, 3), "F"), str(file))
    return intrinsic_matrix([content.get(name) for name in ("fx", "fy", "cx", "cy")], str(file))
