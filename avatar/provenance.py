"""What a rendered video says of itself: that it is synthetic, and which avatar made it. Anyone may ask a file:

    python -m avatar.provenance VIDEO [AVATAR]

The sentence stands in the container's `comment`, which players show (ffprobe, VLC, file managers). It is a label, not a
protection: who re-encodes a video may drop it.
"""

from __future__ import annotations

import hashlib
import re
import sys
from pathlib import Path

import av

SYNTHETIC = "Synthetic: the head in this video was rendered by a trained avatar, not filmed;"
FILMED = "Real frames: training pictures of the same video, or their mean, as a trivial prediction; not rendered by an avatar."
"""Of the trivial predictors' videos."""
_HASH = re.compile(r"avatar sha256:([0-9a-f]{64})")


def avatar_sha256(avatar_path: Path | str) -> str:
    """Hash of an avatar's file, 64 hex digits."""
    with open(avatar_path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def synthetic_comment(avatar_path: Path | str) -> str:
    """The sentence for a video that an avatar's file rendered, input beside it or not; for `write_video(comment=...)`."""
    return f"{SYNTHETIC} avatar sha256:{avatar_sha256(avatar_path)}"


def read_comment(video_path: Path | str) -> str | None:
    """The `comment` of a video's container; None where it has none.

    Raises av.error.FFmpegError (an OSError or ValueError too) where the file is no video.
    """
    with av.open(str(video_path), metadata_errors="replace") as container:
        named = {key.lower(): value for key, value in container.metadata.items()}
    return named.get("comment")


def avatar_of(comment: str | None) -> str | None:
    """The avatar's sha256 in a synthetic video's comment; None for any other comment."""
    found = _HASH.search(comment or "")
    return found[1] if found and SYNTHETIC in comment else None


def check(video_path: Path | str, avatar_path: Path | str) -> None:
    """Raise ValueError unless the video says that it is synthetic and was rendered by this avatar."""
    comment = read_comment(video_path)
    stated, expected = avatar_of(comment), avatar_sha256(avatar_path)
    if stated is None:
        raise ValueError(f"{video_path} does not say that it is synthetic (comment: {comment})")
    if stated != expected:
        raise ValueError(f"{video_path} was rendered by avatar sha256:{stated}, but {avatar_path} is sha256:{expected}")


def main(argv: list[str] | None = None) -> int:
    """Print what a video says of itself; with an avatar, exit status 1 unless that avatar rendered it."""
    words = sys.argv[1:] if argv is None else argv
    if len(words) not in (1, 2):
        print("usage: python -m avatar.provenance VIDEO [AVATAR]", file=sys.stderr)
        return 2
    video, *avatars = words
    try:
        print(read_comment(video) or "no comment")
        for path in avatars:
            check(video, path)
    except (OSError, ValueError, av.error.FFmpegError) as error:
        print(error, file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
