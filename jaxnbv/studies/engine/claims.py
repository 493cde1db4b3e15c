"""Whether what the paper says of a study holds in its records."""

from collections.abc import Sequence
from typing import NamedTuple

from jaxnbv.studies.engine.measures import UNKNOWING, Claim, Row
from jaxnbv.studies.engine.study import Study
from jaxnbv.studies.engine.tables import difference_text, tight


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
        wanted = ("ahead of",) if self.claim.ahead else ("ahead of", "level with")
        return sum(where in wanted for where, _ in self.against.values())

    @property
    def sentence(self) -> str:
        """What was found, the best first."""
        parts = []
        for where in ("ahead of", "level with", "behind"):
            named = [f"{method} ({text})" for method, (found, text) in self.against.items() if found == where]
            parts += [f"{where} {', '.join(named)}"] if named else []
        return f"Holds against {self.held} of {len(self.against)}: {'; '.join(parts)}."


def verdicts(study: type[Study], differences: Sequence[Row]) -> list[Verdict]:
    """On the claims of which a study's differences over all its scenes tell. Methods that were not run are left out;
    those that know no shapes are held against it too."""
    found = []
    for claim in study.claims:
        measure, here = study.measure(claim.measure), ("all", claim.measure, claim.at)
        rows = {row["baseline"]: row for row in differences if (row["group"], row["quantity"], row["at"]) == here}
        against = {}
        named = (f"{method}{way}" for method in claim.than for way in ("", UNKNOWING))
        for method in (method for method in named if method in rows):
            row = rows[method]
            where = "level with"
            if row["excludes_zero"]:
                where = "ahead of" if (row["mean"] < 0) == (measure.better == "less") else "behind"
            against[method] = where, tight(difference_text(row, measure).rstrip("* "))
        if against:
            found.append(Verdict(claim, against))
    return found
