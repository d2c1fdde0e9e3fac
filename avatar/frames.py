"""Which test frames are rendered and scored: one rule for the renderer and for the trivial predictors."""


def chosen_frames(test: list[int], max_frames: int | None) -> list[int]:
    """At most `max_frames` frames, evenly spaced over the test frames, first and last among them.

    test: frame indices, in order.
    max_frames: None keeps every frame; 1 keeps the middle one.
    Raises ValueError when `max_frames` is below 1.
    """
    if max_frames is not None and max_frames < 1:
        raise ValueError(f"max_frames must be at least 1, found {max_frames}")
    if max_frames is None or len(test) <= max_frames:
        return list(test)
    if max_frames == 1:
        return [test[len(test) // 2]]
    last = len(test) - 1
    return [test[(index * last + (max_frames - 1) // 2) // (max_frames - 1)] for index in range(max_frames)]
