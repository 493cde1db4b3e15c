"""Finds pixels of a recording that show the camera's own mount, such as a gripper. The mount moves with the camera."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float, Int, UInt16
from scipy.ndimage import maximum_filter, minimum_filter
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from jaxnbv.geometry.camera import Camera

# Number of frames to compare, least number of frames that must show the mount, and number of blocks along the longer
# side of an image.
_FRAMES, _FEWEST, _BLOCKS = 16, 4, 80
# Relative difference up to which depths count as equal: the depths of a block in different frames, and the depths of a
# point in two frames.
_EQUAL, _ALIKE = 0.02, 0.05
# Neighbouring blocks belong to the same component if their depths differ by at most this factor.
_OF_PART = 1.1
# A component belongs to the mount if other frames look through its position in the world more than this many times as
# often as they see a surface there.
_CLEAR = 4


def own_parts(
    image: Callable[[int], UInt16[np.ndarray, "h w"]],
    matrices: Float[np.ndarray, "n 4 4"],
    camera: Camera,
    scale: float,
) -> Float[np.ndarray, "h w"]:
    """Return, for each pixel, the depth up to which it shows the camera's mount; zero where it does not.

    Depths are in units of the images. Most frames show the mount at the same pixels and at the same depth. Frames from
    other poses look through the place in the world where the mount was during one frame, and see something deeper. A
    vase in the middle of an orbit also has nearly equal depths in all frames, but all frames see the vase at the same
    place in the world.

    - `image`: returns the depth image of a frame, 0 where nothing was measured.
    - `matrices`: poses of the frames, camera to world, OpenCV's axes.
    - `scale`: length of a unit of the images in world units.
    """
    indices = np.unique(np.linspace(0, len(matrices) - 1, _FRAMES).astype(int))
    side = -(-max(camera.height, camera.width) // _BLOCKS)
    images = {int(frame): image(int(frame)) for frame in indices}
    frames = [frame for frame, depth in images.items() if depth.shape == (camera.height, camera.width)]
    depths = np.stack([_nearest_of_blocks(images[frame], side) for frame in frames])
    measured = depths > 0
    often = (2 * measured.sum(axis=0) >= len(frames)) & (measured.sum(axis=0) >= _FEWEST)
    rows = np.where(measured & often, depths, np.nan)[:, often]
    part = np.zeros(depths.shape[1:])
    if rows.size:
        low, middle, high = np.nanpercentile(rows, [10, 50, 90], axis=0)
        part[often] = np.where(high - low < _EQUAL * middle, middle, 0.0)
    if part.any():
        part = np.where(_is_looked_through(scale * part, scale * depths, matrices[frames], camera, side), part, 0.0)
    reach = _OF_PART * maximum_filter(part, 3)
    return np.kron(reach, np.ones((side, side)))[: camera.height, : camera.width]


def _nearest_of_blocks(image: UInt16[np.ndarray, "h w"], side: int) -> Float[np.ndarray, "k l"]:
    """Return the least depth in each block of `side` x `side` pixels; zero if nothing was measured in it."""
    image = np.pad(image, [(0, -size % side) for size in image.shape]).astype(float)
    blocks = np.where(image > 0, image, np.inf).reshape(image.shape[0] // side, side, image.shape[1] // side, side)
    least = blocks.min(axis=(1, 3))
    return np.where(np.isfinite(least), least, 0.0)


def _is_looked_through(
    part: Float[np.ndarray, "k l"],
    depths: Float[np.ndarray, "n k l"],
    matrices: Float[np.ndarray, "n 4 4"],
    camera: Camera,
    side: int,
) -> Bool[np.ndarray, "k l"]:
    """Return a mask of the connected components of `part` that belong to the mount.

    A component belongs to the mount if other frames see through the place in the world where it was during one frame.

    - `part`: depths of the blocks with the same depth in most frames, in world units; zero in all other blocks.
    - `depths`: depths of the blocks in each frame, in world units.
    - `side`: length of a block's side in pixels.
    """
    row, column = np.nonzero(part)
    own, count = _pieces(part)
    (fx, skew, cx), (_, fy, cy), _ = np.asarray(camera.intrinsics, float)
    down = (side * (row + 0.5) - cy) / fy
    rays = np.stack([(side * (column + 0.5) - cx - skew * down) / fx, down, np.ones(len(row))], axis=-1)
    points = part[row, column, None] * rays
    deeper, alike = np.zeros(count), np.zeros(count)
    # Use bounds of the depths around a block, since the surface may be slanted and the point may be anywhere in the
    # block.
    window = (1, 3, 3)
    least = minimum_filter(np.where(depths > 0, depths, np.inf), window)
    most = maximum_filter(depths, window)
    for first, matrix in enumerate(matrices):
        is_shown = np.abs(depths[first, row, column] - part[row, column]) < _EQUAL * part[row, column]
        for second, other in enumerate(matrices):
            move = np.linalg.inv(other) @ matrix
            moved = points @ move[:3, :3].T + move[:3, 3]
            is_valid = is_shown & (moved[:, 2] > 0) & (first != second)
            across, along = (moved[:, :2] / np.where(is_valid, moved[:, 2], 1.0)[:, None]).T
            at = np.floor(np.stack([fy * along + cy, fx * across + skew * along + cx]) / side)
            is_valid &= np.all((at >= 0) & (at < np.array(part.shape)[:, None]), axis=0)
            block = second, *np.where(is_valid, at, 0).astype(int)
            is_valid &= depths[block] > 0
            is_deeper = least[block] > (1.0 + _ALIKE) * moved[:, 2]
            is_before = most[block] < (1.0 - _ALIKE) * moved[:, 2]
            np.add.at(deeper, own[is_valid & is_deeper], 1)
            np.add.at(alike, own[is_valid & ~is_deeper & ~is_before], 1)
    mask = np.zeros(part.shape, bool)
    mask[row, column] = (deeper > _CLEAR * alike)[own]
    return mask


def _pieces(part: Float[np.ndarray, "k l"]) -> tuple[Int[np.ndarray, " blocks"], int]:
    """Return the index of the connected component of each block with positive depth, and their number.

    Neighbouring blocks at about the same depth belong to the same component.
    """
    padded = np.pad(part, 1)
    number = np.zeros(padded.shape, int)
    number[padded > 0] = np.arange(np.count_nonzero(part))
    pairs = []
    for down, right in ((0, 1), (1, -1), (1, 0), (1, 1)):
        other = np.roll(padded, (-down, -right), axis=(0, 1))
        near, far = np.minimum(padded, other), np.maximum(padded, other)
        joined = (near > 0) & (far <= _OF_PART * near)
        pairs.append(np.stack([number[joined], np.roll(number, (-down, -right), axis=(0, 1))[joined]]))
    first, second = np.concatenate(pairs, axis=1)
    graph = coo_array((np.ones(len(first)), (first, second)), shape=(np.count_nonzero(part),) * 2)
    count, own = connected_components(graph, directed=False)
    return own, count
