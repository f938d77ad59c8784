"""Names of the methods that solve frames, in the order in which an approaching ship meets them."""

METHODS = {
    "brightness_centre": "brightness centre",
    "horizon_sphere": "horizon, smooth body",
    "horizon": "horizon",
    "control_points": "control points",
}


def method_words(method: str) -> str:
    """A method's name for people; a name that is not known stays as it is."""
    return METHODS.get(method, method.replace("_", " ") or "unnamed")


def method_rank(method: str) -> tuple[int, str]:
    """By which methods are ordered: from afar to near, unknown ones last."""
    names = list(METHODS)
    return (names.index(method) if method in names else len(names), method)
