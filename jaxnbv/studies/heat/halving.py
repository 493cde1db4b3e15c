"""Successive halving beside the full search: does it find the same view, and what does it save?"""

import time
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import PRNGKeyArray

from jaxnbv.planning.planner import Planner
from jaxnbv.scanning import Evidence, GridSurface
from jaxnbv.search import HalvingSearch, Proposal
from jaxnbv.studies.engine.measures import Record, Row
from jaxnbv.studies.engine.tables import count_of, underlined


def compare(
    halving: Planner, evidence: Evidence, surfaces: GridSurface | None, key: PRNGKeyArray, full: Proposal
) -> dict[str, Any]:
    """Ask the other search the same: whether it finds the same view, how much less the full search values that, and its
    seconds."""
    start = time.perf_counter()
    halved = jax.block_until_ready(halving.choose(evidence, surfaces, key))
    seconds, places = time.perf_counter() - start, np.asarray(full.candidates.position)
    found, best = (int(np.argmin(np.linalg.norm(places - one.pose.position, axis=1))) for one in (halved, full))
    return {
        "same": found == best,
        "regret": float(full.value - full.values[found]),
        "seconds": seconds,
        "evaluations": halving_evaluations(len(places), halving.imagination.num_samples),
        "full_evaluations": len(places) * halving.imagination.num_samples,
    }


def halving_evaluations(candidates: int, samples: int) -> int:
    """How many imagined scans a `HalvingSearch` scores; a `DiscreteSearch` scores `candidates` * `samples`."""
    left, scored, total = candidates, 0, 0
    while scored < samples:
        left = max(1, left // 2) if scored else left
        more = min(max(scored, HalvingSearch.num_first_samples), samples - scored)
        total, scored = total + left * more, scored + more
    return total


def halving_rows(records: Sequence[Record], reference: str) -> list[Row]:
    """The two searches on the same states and samples: one row, or none where they were not compared.

    Steps at which every view had the value zero are left out, but for the seconds, which are medians over all steps.
    """
    runs = [record["methods"][reference] for record in records if reference in record["methods"]]
    pairs = [pair for run in runs for pair in zip(run["steps"], run.get("halving", ()), strict=False)]
    if not pairs:
        return []
    open_pairs = [(full, halved) for full, halved in pairs if full["value"] > 0.0]

    def mean(values: list) -> float:
        return float(np.mean(values)) if values else float("nan")

    return [
        {"steps": len(pairs), "open_steps": len(open_pairs)}
        | {"same_view": mean([halved["same"] for _, halved in open_pairs])}
        | {"mean_regret": mean([halved["regret"] for _, halved in open_pairs])}
        | {"mean_value": mean([full["value"] for full, _ in open_pairs])}
        | {name: pairs[0][1][name] for name in ("full_evaluations", "evaluations")}
        | {"full_seconds": float(np.median([full["seconds"] for full, _ in pairs]))}
        | {"seconds": float(np.median([halved["seconds"] for _, halved in pairs]))}
    ]


def halving_notes(records: Sequence[Record], reference: str) -> list[str]:
    """The same as text."""
    return [
        underlined("Successive halving in place of the full search, same states and samples")
        + f"{row['open_steps']} of {count_of(row['steps'], 'step')} have a view of a value above zero. Of these:\n"
        f"  the same view:           {row['same_view']:.0%}\n"
        f"  mean loss of value:      {row['mean_regret']:.4f} of {row['mean_value']:.4f} degrees\n"
        "All steps:\n"
        f"  imagined scans scored:   {row['evaluations']} in place of {row['full_evaluations']}\n"
        f"  seconds, median:         {row['seconds']:.1f} in place of {row['full_seconds']:.1f}\n"
        for row in halving_rows(records, reference)
    ]
