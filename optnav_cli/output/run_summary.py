"""What came of a run, as a few lines for people."""

import math
from collections import Counter
from collections.abc import Sequence

import numpy as np

from optnav_cli.fix import Method, Solution
from optnav_cli.output.wording import length_unit, plural, table_lines


def run_lines(solutions: Sequence[Solution]) -> list[str]:
    """How many frames are solved, by which method and how well, and why others are not."""
    sigmas: dict[str, list[float]] = {}
    for s in solutions:
        if s.covariance_m2 is not None:
            sigma = math.sqrt(max(float(np.trace(s.covariance_m2)), 0.0) / 3.0)
            sigmas.setdefault(Method(s.method).label, []).append(sigma)
    solved = sum(map(len, sigmas.values()))
    lines = [f"solved {solved} of {len(solutions)} {plural('frame', len(solutions))}"]
    if sigmas:
        unit = length_unit(max(map(max, sigmas.values())))
        rows = [("method", "frames", f"median sigma an axis, {unit.name}", "largest")]
        for method, found in sorted(sigmas.items()):
            median, largest = unit.text(float(np.median(found))), unit.text(max(found))
            rows.append((method, str(len(found)), median, largest))
        lines += table_lines(rows)
    reasons = Counter(s.reason_code.label for s in solutions if not s.solved)
    lines += [f"unsolved, {reason}: {count}" for reason, count in reasons.most_common()]
    return lines
