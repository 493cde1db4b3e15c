"""Successive halving beside the full search: does it find the same view, and what does it save?"""

import time
from typing import Any

import jax
import numpy as np
from jaxtyping import PRNGKeyArray

from jaxnbv.planning.planner import Planner
from jaxnbv.scanning import Evidence, GridSurface
from jaxnbv.search import Proposal


def compare(
    halving: Planner, evidence: Evidence, surfaces: GridSurface | None, key: PRNGKeyArray, full: Proposal
) -> dict[str, Any]:
    """Ask the other search the same: whether it finds the same view, how much less the full search values that, and its
    seconds."""
    start = time.perf_counter()
    halved = jax.block_until_ready(halving.choose(evidence, surfaces, key))
    seconds, places = time.perf_counter() - start, np.asarray(full.candidates.position)
    found, best = (int(np.argmin(np.linalg.norm(places - one.pose.position, axis=1))) for one in (halved, full))
    return {"same": found == best, "regret": float(full.value - full.values[found]), "seconds": seconds}
