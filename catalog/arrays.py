"""The array types of all modules; shapes and units stand in the docstrings that use them."""

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
Float32Array = NDArray[np.float32]  # heights, m, and brightness: what there is much of
ComplexArray = NDArray[np.complex128]
IntArray = NDArray[np.int64]
Int32Array = NDArray[np.int32]
Int16Array = NDArray[np.int16]
Int8Array = NDArray[np.int8]
IndexArray = NDArray[np.intp]
UInt16Array = NDArray[np.uint16]
ByteArray = NDArray[np.uint8]
BoolArray = NDArray[np.bool_]
RecordArray = NDArray[np.void]
