"""Which matches count against chance: those that stand alone where a rival was looked for.

A search near its place has no room for a rival, and any pattern has a highest place in it: smooth
brightness scores 0.4 to 0.5 anywhere. So points are searched again about the solved pose, farther,
until those that stand alone there carry it.
"""

from collections.abc import Callable, Sequence

# Room to every side, nodes: three times as many places as a peak itself takes.
PROOF_NODES = 12


def drop_disproven(
    stands_alone: Callable[[int], bool],
    strongest: Sequence[int],
    decades: Callable[[list[int]], float],
    least: float,
) -> list[int]:
    """Leave out points whose ground looks alike elsewhere in a wider search.

    stands_alone  whether a point does, in that search
    strongest     points that the solution uses, by what they say against chance, most first
    decades       powers of ten against chance that some of them give;  least that are asked for

    Stops where those that stand alone give enough. Returns the points not left out.
    """
    proven: list[int] = []
    for tried, k in enumerate(strongest, 1):
        if stands_alone(k):
            proven.append(k)
        if proven and decades(proven) >= least:
            return [*proven, *strongest[tried:]]
    return proven
