"""Records between the stages as bytes: msgpack with numpy arrays, guarded by a checksum."""

import hashlib
from collections.abc import Sequence
from typing import Any, TypeVar

import msgspec
import numpy as np
import zstandard

T = TypeVar("T")

MAGIC = b"optnav1\n"
HASH_BYTES = 16


class DamagedRecordsError(ValueError):
    """Bytes that were cut short or changed."""


def encode_records(records: Sequence[Any]) -> bytes:
    """Structs or dataclasses as bytes; the same records give the same bytes."""
    payload = zstandard.ZstdCompressor(level=1).compress(
        msgspec.msgpack.encode(records, enc_hook=_plain)
    )
    return MAGIC + hashlib.sha256(payload).digest()[:HASH_BYTES] + payload


def are_whole(data: bytes) -> bool:
    """Whether bytes of `encode_records` are as they were made."""
    head = len(MAGIC) + HASH_BYTES
    stated = data[len(MAGIC) : head]
    return data.startswith(MAGIC) and (
        hashlib.sha256(memoryview(data)[head:]).digest()[:HASH_BYTES] == stated
    )


def decode_records(data: bytes, type_: type[T]) -> list[T]:
    """The records of a type. Raises DamagedRecordsError."""
    if not are_whole(data):
        raise DamagedRecordsError("checksum differs")
    payload = memoryview(data)[len(MAGIC) + HASH_BYTES :]
    plain = zstandard.ZstdDecompressor().decompress(payload)
    try:
        return msgspec.msgpack.decode(plain, type=list[type_], dec_hook=_array)  # type: ignore[valid-type]
    except msgspec.MsgspecError as error:
        raise DamagedRecordsError(str(error)) from None


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return [value.dtype.str, list(value.shape), np.ascontiguousarray(value).tobytes()]
    if isinstance(value, np.generic):
        return value.item()
    raise NotImplementedError(f"records cannot hold a {type(value).__name__}")


def _array(type_: type, value: Any) -> Any:
    if type_ is np.ndarray:
        dtype, shape, data = value
        return np.frombuffer(data, dtype=np.dtype(dtype)).reshape(shape)
    raise NotImplementedError(f"records cannot hold a {type_.__name__}")
