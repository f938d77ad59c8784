"""Numbers as people say them."""


def duration(seconds: float) -> str:
    """Seconds as people say them: 0.4 s, 12 s, 3 min 05 s, 2 h 10 min."""
    if seconds < 9.95:
        return f"{seconds:.1f} s"
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02d} min"


def speed(rate: float, unit: str) -> str:
    """A rate as people say it: 12.3 cells/s, or 4.0 s a cell when it is slow."""
    if rate <= 0.0:
        return f"no {unit} done yet"
    return f"{rate:.1f} {plural(unit, 2)}/s" if rate >= 1.0 else f"{1.0 / rate:.1f} s a {unit}"


def plural(unit: str, count: int) -> str:
    """The English plural of a unit of work: cells, geometries, pictures; MB stays."""
    if count == 1 or unit.isupper():
        return unit
    if unit.endswith("y"):
        return f"{unit[:-1]}ies"
    return f"{unit}s"


def amount(count: float) -> str:
    """Bytes as people say them: 870 B, 12.3 MB, 1.04 GB."""
    for limit, unit, decimals in ((1e3, "B", 0), (1e6, "kB", 1), (1e9, "MB", 1)):
        if count < 0.9995 * limit:
            return f"{count / (limit / 1e3):.{decimals}f} {unit}"
    return f"{count / 1e9:.2f} GB"
