"""Random numbers that belong to a place: the same seed and the same integers give the same number.

The mixing function is the finaliser of SplitMix64 (Steele, Lea, Flood 2014).
"""

import numpy as np

from catalog.geometry.kernel import kernel

_A = np.uint64(0xBF58476D1CE4E5B9)
_B = np.uint64(0x94D049BB133111EB)
_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_S30, _S27, _S31, _S11 = np.uint64(30), np.uint64(27), np.uint64(31), np.uint64(11)
_TO_UNIT = 1.0 / 9007199254740992.0  # 2^-53


@kernel
def mix(value: np.uint64) -> np.uint64:
    """Scramble 64 bits so that neighbouring inputs give unrelated outputs."""
    value = (value ^ (value >> _S30)) * _A
    value = (value ^ (value >> _S27)) * _B
    return value ^ (value >> _S31)


@kernel
def join(state: np.uint64, number: int) -> np.uint64:
    """A new state from a state and an integer of any sign."""
    return mix(state + _GOLDEN + np.uint64(number) * _B)


@kernel
def unit(state: np.uint64) -> float:
    """The state's number in [0, 1)."""
    return float(state >> _S11) * _TO_UNIT
