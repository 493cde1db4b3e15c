"""Values of a depth image that stand for "not measured", such as 65535, 10000 or 2047."""

import warnings

import numpy as np
from jaxtyping import Bool, Real

# A sentinel fills this many rows or columns, as the image of a floor without noise does not, and this many times the
# pixels of any value within a share of it.
_ROWS, _ABOVE, _NEAR = 2, 20, 0.05
# Where nothing says how far a sensor reaches, a sentinel is this many times any other value.
_BEYOND = 2.0


def sentinel_pixels(image: Real[np.ndarray, "h w"], reach: float) -> Bool[np.ndarray, "h w"]:
    """Which pixels hold a value that a sensor writes where it measured nothing: the largest of an integer type, or one
    beyond the reach that fills far more pixels than any value near it. A `UserWarning` names the second kind.

    Where all pixels hold one value, it is no sentinel: it may be a wall.

    - `image`: in its own units, sentinels included.
    - `reach`: the value beyond which nothing that counts is measured; infinite where this is not known: then a sentinel
      is twice any other value at least.
    """
    is_integer = np.issubdtype(image.dtype, np.integer)
    largest = image == np.iinfo(image.dtype).max if is_integer else np.zeros(image.shape, bool)
    measured = image[np.isfinite(image) & (image > 0) & ~largest]
    if not len(measured):
        return largest
    if np.isinf(reach):
        others = measured[measured < measured.max()]
        reach = _BEYOND * others.max(initial=0)
    values, counts = np.unique(measured[measured > reach], return_counts=True)
    sentinels = []
    for index in np.flatnonzero((counts > _ROWS * max(image.shape)) & (counts < len(measured))):
        low, high = np.searchsorted(values, values[index] * np.array([1.0 - _NEAR, 1.0 + _NEAR]))
        if counts[index] < _ABOVE * np.delete(counts[low:high], index - low).max(initial=0):
            continue
        sentinels.append(index)
        warnings.warn(
            f"the depth image has the value {values[index]:g} in {counts[index]} pixels, as no measured surface would: "
            "it is taken for a mark of pixels that were not measured. Give infinity where a ray met nothing",
            stacklevel=5,
        )
    return largest | np.isin(image, values[sentinels])
