"""Sizes of errors by maximum likelihood: which of them the data tell, and the likeliest ones.

A prior of one PRIOR in the logarithm holds each size at the present one: a size about which the
data say nothing stays.
"""

from collections.abc import Callable, Iterable, Mapping

import numpy as np
from scipy.optimize import minimize

from catalog.arrays import FloatArray
from tests.studies.tables import Cell, StudyTable, columns

# Logarithm of the likelihood when sizes, by their names, are multiplied by factors; others stay.
Likelihood = Callable[[Mapping[str, float]], float]

PRIOR = float(np.log(2.0))
MIN_DROP = 0.5  # of the logarithm, by halving or doubling: below it a size stays
NOTE = (
    f"logarithms of the likelihood; sizes that change it by less than {MIN_DROP} by halving and "
    "doubling stay"
)
COLUMNS = columns(
    "size; old .3g; new .3g; half = halved, drop .1f; twice = doubled, drop .1f; fitted"
)


def drops(likelihood: Likelihood, names: Iterable[str]) -> dict[str, tuple[float, float]]:
    """By how much halving and doubling each size lowers the logarithm of the likelihood."""
    best = likelihood({})
    return {
        name: (best - likelihood({name: 0.5}), best - likelihood({name: 2.0})) for name in names
    }


def likeliest_factors(
    likelihood: Likelihood, names: Iterable[str], max_factor: float
) -> dict[str, float]:
    """The likeliest factors, at most max_factor up or down, of the sizes that the data tell."""
    found = drops(likelihood, names)
    known = [name for name, pair in found.items() if max(map(abs, pair)) > MIN_DROP]

    def factors(logs: FloatArray) -> dict[str, float]:
        return dict(zip(known, np.exp(logs).tolist(), strict=True))

    def cost(logs: FloatArray) -> float:
        return 0.5 * float(((logs / PRIOR) ** 2).sum()) - likelihood(factors(logs))

    limit = float(np.log(max_factor))
    best = minimize(
        cost, np.zeros(len(known)), method="L-BFGS-B", bounds=[(-limit, limit)] * len(known),
        options={"maxiter": 20, "ftol": 1e-6},
    )  # fmt: skip
    return factors(best.x)


def with_numbers(text: str, old: Mapping[str, float], new: Mapping[str, float]) -> str:
    """A TOML text with values of "section.name" changed, to two digits; comments stay."""
    section, lines = "", []
    for line in text.splitlines():
        if line.startswith("["):
            section = line[1 : line.index("]")]
        start, _, rest = line.partition("= ")
        name = f"{section}.{start.strip()}"
        if name in new and new[name] != old[name]:
            value, mark, comment = rest.partition("#")
            shown = f"{new[name]:.2g}".ljust(len(value))
            line = f"{start}= {shown}{mark}{comment}"
        lines.append(line)
    return "\n".join(lines) + "\n"


def sizes_table(
    old: Mapping[str, float], new: Mapping[str, float], found: Mapping[str, tuple[float, float]]
) -> StudyTable:
    """Sizes before and after, with what `drops` found of the new ones."""
    rows: list[tuple[Cell, ...]] = [
        (name, old[name], new[name], *pair, "yes" if new[name] != old[name] else "no")
        for name, pair in found.items()
    ]
    return StudyTable("Sizes", COLUMNS, tuple(rows))
