"""Finds pixels of a recording that show the camera's own mount, such as a gripper, which moves with the camera."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float, Int, UInt16
from scipy.ndimage import maximum_filter, minimum_filter
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from jaxnbv.geometry.camera import Camera

# Number of frames to compare, smallest number that must measure a depth, and square blocks along the longer side.
_NUM_FRAMES, _MIN_FRAMES, _NUM_BLOCKS = 16, 4, 80
# Relative differences up to which depths count as equal: for a block in all frames, and for a point in two frames.
_BLOCK_TOLERANCE, _POINT_TOLERANCE = 0.02, 0.05
# Neighbouring blocks belong to the same component if their depths differ by at most this factor.
_MAX_DEPTH_RATIO = 1.1
# A component is part of the mount if frames see through its place more than this many times as often as they see a
# surface there.
_MIN_DEEPER_RATIO = 4


def own_parts(
    image: Callable[[int], UInt16[np.ndarray, "h w"]],
    matrices: Float[np.ndarray, "n 4 4"],
    camera: Camera,
    scale: float,
) -> Float[np.ndarray, "h w"]:
    """Return, for each pixel, the largest depth that counts as the camera's mount; zero for other pixels.

    Depths are in units of the images. A mount has the same depth at the same pixels in most frames, and moves with the
    camera. So where the mount was in the world during one frame, frames from other poses see something deeper. A vase
    in the middle of an orbit also has nearly the same depth in all frames, but stays at one place in the world.

    - `image`, `matrices`: as in `depth_unit`.
    - `scale`: length of a unit of the images in world units.
    """
    indices = np.unique(np.linspace(0, len(matrices) - 1, _NUM_FRAMES).astype(int))
    side = -(-max(camera.height, camera.width) // _NUM_BLOCKS)
    images = {int(frame): image(int(frame)) for frame in indices}
    frames = [frame for frame, depth in images.items() if depth.shape == (camera.height, camera.width)]
    depths = np.stack([_block_minima(images[frame], side) for frame in frames])
    is_measured = depths > 0
    is_frequent = (2 * is_measured.sum(axis=0) >= len(frames)) & (is_measured.sum(axis=0) >= _MIN_FRAMES)
    rows = np.where(is_measured & is_frequent, depths, np.nan)[:, is_frequent]
    candidate_depth = np.zeros(depths.shape[1:])
    if rows.size:
        low, middle, high = np.nanpercentile(rows, [10, 50, 90], axis=0)
        candidate_depth[is_frequent] = np.where(high - low < _BLOCK_TOLERANCE * middle, middle, 0.0)
    if candidate_depth.any():
        is_mount = _is_mount(scale * candidate_depth, scale * depths, matrices[frames], camera, side)
        candidate_depth = np.where(is_mount, candidate_depth, 0.0)
    max_depths = _MAX_DEPTH_RATIO * maximum_filter(candidate_depth, 3)
    return np.kron(max_depths, np.ones((side, side)))[: camera.height, : camera.width]


def _block_minima(image: UInt16[np.ndarray, "h w"], side: int) -> Float[np.ndarray, "k l"]:
    """Return the least depth in each block of `side` x `side` pixels; zero where nothing was measured."""
    image = np.pad(image, [(0, -size % side) for size in image.shape]).astype(float)
    blocks = np.where(image > 0, image, np.inf).reshape(image.shape[0] // side, side, image.shape[1] // side, side)
    least = blocks.min(axis=(1, 3))
    return np.where(np.isfinite(least), least, 0.0)


def _is_mount(
    candidate_depth: Float[np.ndarray, "k l"],
    depths: Float[np.ndarray, "n k l"],
    matrices: Float[np.ndarray, "n 4 4"],
    camera: Camera,
    side: int,
) -> Bool[np.ndarray, "k l"]:
    """Return a mask of the blocks that show the camera's mount.

    These are the connected components of `candidate_depth` at whose place in the world other frames see empty space.

    - `candidate_depth`: depth of each block that has the same depth in most frames, in world units; zero elsewhere.
    - `depths`: least depth of each block in each frame, in world units; zero where nothing was measured.
    - `side`: length of a block's side in pixels.
    """
    row, column = np.nonzero(candidate_depth)
    component, count = _components(candidate_depth)
    (fx, skew, cx), (_, fy, cy), _ = np.asarray(camera.intrinsics, float)
    down = (side * (row + 0.5) - cy) / fy
    rays = np.stack([(side * (column + 0.5) - cx - skew * down) / fx, down, np.ones(len(row))], axis=-1)
    block_depths = candidate_depth[row, column]
    points = block_depths[:, None] * rays
    num_deeper, num_equal = np.zeros(count), np.zeros(count)
    # Compare a point with the least and greatest depth of its block and the neighbours, because the surface may be
    # slanted and the point may lie anywhere in the block.
    window = (1, 3, 3)
    least = minimum_filter(np.where(depths > 0, depths, np.inf), window)
    greatest = maximum_filter(depths, window)
    for first, matrix in enumerate(matrices):
        is_shown = np.abs(depths[first, row, column] - block_depths) < _BLOCK_TOLERANCE * block_depths
        for second, other in enumerate(matrices):
            motion = np.linalg.inv(other) @ matrix
            second_points = points @ motion[:3, :3].T + motion[:3, 3]
            is_valid = is_shown & (second_points[:, 2] > 0) & (first != second)
            x, y = (second_points[:, :2] / np.where(is_valid, second_points[:, 2], 1.0)[:, None]).T
            position = np.floor(np.stack([fy * y + cy, fx * x + skew * y + cx]) / side)
            is_valid &= np.all((position >= 0) & (position < np.array(candidate_depth.shape)[:, None]), axis=0)
            block = second, *np.where(is_valid, position, 0).astype(int)
            is_valid &= depths[block] > 0
            is_deeper = least[block] > (1.0 + _POINT_TOLERANCE) * second_points[:, 2]
            is_before = greatest[block] < (1.0 - _POINT_TOLERANCE) * second_points[:, 2]
            np.add.at(num_deeper, component[is_valid & is_deeper], 1)
            np.add.at(num_equal, component[is_valid & ~is_deeper & ~is_before], 1)
    mask = np.zeros(candidate_depth.shape, bool)
    mask[row, column] = (num_deeper > _MIN_DEEPER_RATIO * num_equal)[component]
    return mask


def _components(candidate_depth: Float[np.ndarray, "k l"]) -> tuple[Int[np.ndarray, " blocks"], int]:
    """Return the component of each block with positive depth, and the number of components.

    Neighbouring blocks at about the same depth belong to the same component.
    """
    padded = np.pad(candidate_depth, 1)
    number = np.zeros(padded.shape, int)
    number[padded > 0] = np.arange(np.count_nonzero(candidate_depth))
    pairs = []
    for down, right in ((0, 1), (1, -1), (1, 0), (1, 1)):
        other = np.roll(padded, (-down, -right), axis=(0, 1))
        near, far = np.minimum(padded, other), np.maximum(padded, other)
        is_joined = (near > 0) & (far <= _MAX_DEPTH_RATIO * near)
        pairs.append(np.stack([number[is_joined], np.roll(number, (-down, -right), axis=(0, 1))[is_joined]]))
    first, second = np.concatenate(pairs, axis=1)
    graph = coo_array((np.ones(len(first)), (first, second)), shape=(np.count_nonzero(candidate_depth),) * 2)
    count, component = connected_components(graph, directed=False)
    return component, count
