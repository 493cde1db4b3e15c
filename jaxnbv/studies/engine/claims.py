"""Whether what the paper says of a study holds in its records."""

from typing import NamedTuple

import pandas as pd

from jaxnbv.studies.engine.measures import UNKNOWING, Claim
from jaxnbv.studies.engine.study import Study
from jaxnbv.studies.engine.tables import difference_text

_WHERE = ("ahead of", "level with", "behind")


class Verdict(NamedTuple):
    """A claim, and how the reference fares beside the methods that it names.

    - `against`: by method, "ahead of", "level with" or "behind", and the paired difference with its interval. It is
      level where the interval includes zero.
    """

    claim: Claim
    against: dict[str, tuple[str, str]]

    @property
    def held(self) -> int:
        """Against how many of the methods the claim holds."""
        return sum(where in _WHERE[: 1 if self.claim.ahead else 2] for where, _ in self.against.values())

    @property
    def sentence(self) -> str:
        """What was found, the best first."""
        told = [(where, f"{method} ({text})") for method, (where, text) in self.against.items()]
        parts = [
            f"{where} {', '.join(named)}" for where in _WHERE if (named := [text for at, text in told if at == where])
        ]
        return f"Holds against {self.held} of {len(self.against)}: {'; '.join(parts)}."


def verdicts(study: type[Study], differences: pd.DataFrame) -> list[Verdict]:
    """On the claims of which a study's differences over all its scenes tell. Methods that were not run are left out;
    those that know no shapes are held against it too."""
    found = []
    for claim in study.claims:
        measure = study.measure(claim.measure)
        here = differences[(differences["group"] == "all") & (differences["quantity"] == claim.measure)]
        rows = here[here["at"] == claim.at].set_index("baseline")
        named = (f"{method}{way}" for method in claim.than for way in ("", UNKNOWING))
        against = {}
        for method, row in ((method, rows.loc[method]) for method in named if method in rows.index):
            better = (row["mean"] < 0) == (measure.better == "less")
            where = _WHERE[1] if not row["excludes_zero"] else _WHERE[0 if better else 2]
            against[method] = where, difference_text(row, measure).rstrip("*")
        if against:
            found.append(Verdict(claim, against))
    return found
