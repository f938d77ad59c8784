"""Damage to bytes, without an idea of what they mean."""

import random

MAGICS = (
    b"\x89PNG\r\n\x1a\n", b"II*\x00", b"II+\x00", b"SQLite format 3\x00", b"glTF", b"ply\n", b"P5\n", b"\xff\xd8\xff",
    b"DAF/SPK ", b"KPL/PCK\n", b"PDS_VERSION_ID = PDS3\r\n", b"<VRTDataset", b"<GDAL_WMS>", b"ncols 4\n",
    b"\x1f\x8b", b"PK\x03\x04", b"%PDF", b"GIF89a", b"BM", b"\x89HDF\r\n\x1a\n", b"CDF\x01",
)  # fmt: skip


def damaged(data: bytes, rng: random.Random) -> tuple[bytes, str]:
    """The data with a damage, and what it is."""
    ways = (
        _flipped, _flipped, _flipped, _overwritten, _cut, _cut, _beheaded, _zeroed, _without,
        _doubled, _longer, _with_noise, _magic, _empty, _of_ones,
    )  # fmt: skip
    return rng.choice(ways)(data, rng)


def _place(data: bytes, rng: random.Random) -> int:
    """Anywhere, but half of the time near the beginning, where the structure is."""
    most = len(data) if rng.random() < 0.5 else min(len(data), 600)
    return rng.randrange(max(1, most))


def _flipped(data: bytes, rng: random.Random) -> tuple[bytes, str]:
    changed = bytearray(data)
    places = [_place(data, rng) for _ in range(rng.choice((1, 1, 1, 2, 5, 40)))]
    for place in places if data else ():
        changed[place] ^= 1 << rng.randrange(8)
    return bytes(changed), f"bits flipped at {places[:5]}"


def _overwritten(data: bytes, rng: random.Random) -> tuple[bytes, str]:
    place, count = _place(data, rng), rng.choice((1, 2, 4, 8))
    value = rng.choice((b"\x00", b"\xff", b"\x7f", b"\x80", b"9", b"-", b"\n"))
    return data[:place] + value * count + data[place + count :], f"{value!r} x {count} at {place}"


def _cut(data: bytes, rng: random.Random) -> tuple[bytes, str]:
    place = rng.randrange(len(data) + 1)
    return data[:place], f"cut after {place} bytes"


def _beheaded(data: bytes, rng: random.Random) -> tuple[bytes, str]:
    count = rng.choice((1, 4, 16, 200))
    return data[count:], f"first {count} bytes gone"


def _zeroed(data: bytes, rng: random.Random) -> tuple[bytes, str]:
    place, count = _place(data, rng), rng.choice((16, 512, 4096))
    return data[:place] + bytes(len(data[place : place + count])) + data[place + count :], (
        f"{count} zeros at {place}"
    )


def _without(data: bytes, rng: random.Random) -> tuple[bytes, str]:
    place, count = _place(data, rng), rng.choice((1, 7, 512))
    return data[:place] + data[place + count :], f"{count} bytes gone at {place}"


def _doubled(data: bytes, rng: random.Random) -> tuple[bytes, str]:
    place, count = _place(data, rng), rng.choice((1, 60, 512))
    return data[: place + count] + data[place:], f"{count} bytes twice at {place}"


def _longer(data: bytes, rng: random.Random) -> tuple[bytes, str]:
    return data + rng.randbytes(rng.choice((1, 100, 5000))), "noise at the end"


def _with_noise(data: bytes, rng: random.Random) -> tuple[bytes, str]:
    place = _place(data, rng)
    return data[:place] + rng.randbytes(rng.choice((1, 4, 64))) + data[place:], f"noise at {place}"


def _magic(data: bytes, rng: random.Random) -> tuple[bytes, str]:
    magic = rng.choice(MAGICS)
    return magic + data[len(magic) :], f"begins with {magic!r}"


def _empty(data: bytes, rng: random.Random) -> tuple[bytes, str]:
    return b"", "empty"


def _of_ones(data: bytes, rng: random.Random) -> tuple[bytes, str]:
    return b"\xff" * len(data), "all bytes 255"
