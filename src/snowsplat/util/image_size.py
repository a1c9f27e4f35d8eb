"""`scaled_size`: the size of a reduced image. Without libraries: workers start with it."""


def scaled_size(width: int, height: int, longest: int | None) -> tuple[int, int]:
    """The size of an image with its longest side at most ``longest`` pixels; never enlarged."""
    if longest is None or max(width, height) <= longest:
        return width, height
    scale = longest / max(width, height)
    return max(1, round(width * scale)), max(1, round(height * scale))
