"""Step `uses_page`: what an avatar was used for, on one page: videos, pictures and reports of the uses that it is given.

Input: lists videos (mp4), pictures (png, jpg, svg), reports (JSON), each file in its use's folder
`results/{subject}/{variant}/{orbit, extrapolate, sheet, flicker, drive/DRIVER, animate/NAME}/`. Not all lists may be empty.
Output: page, a folder with index.html. The page makes nothing be made: its rule says which uses it wants.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from avatar import provenance
from avatar.report import uses_template
from avatar.report.config import UsesConfig
from avatar.report.page_parts import Folder, facts, words
from avatar.report.results import many
from workflow import step

KNOWN = {
    "drive": "The avatar moved by another video: the driving video beside the render.",
    "animate": "The avatar moved by a file of parameters.",
    "orbit": "The camera moves around the head on an arc.",
    "extrapolate": "Expression codes as tracked and made stronger: what lies outside the training poses is a guess.",
    "sheet": "Chosen frames: input, render, error, depth, normals, tracked mesh and opacity.",
    "flicker": "How much the render flickers on a still stretch, beside the video's own flicker.",
}
"""Uses in the order of the page, with a caption; others follow by name."""
OF_MANY = ("drive", "animate")
"""Uses with a folder for each video or file that moves the avatar."""


def use_of(path: Path) -> tuple[str, str]:
    """Use of a file, and what moves the avatar: `.../drive/bob/x.mp4` -> drive, bob; `.../orbit/x.mp4` -> orbit, nothing."""
    folder = path.parent
    return (folder.parent.name, folder.name) if folder.parent.name in OF_MANY else (folder.name, "")


def grouped(paths: dict[str, list[Path]]) -> list[tuple[tuple[str, str], dict[str, list[Path]]]]:
    """Files by use, each with its videos, pictures and reports; known uses first."""
    groups: dict[tuple[str, str], dict[str, list[Path]]] = {}
    for kind, found in paths.items():
        for path in found:
            groups.setdefault(use_of(path), {name: [] for name in paths})[kind].append(path)
    order = list(KNOWN)
    return sorted(groups.items(), key=lambda item: (order.index(item[0][0]) if item[0][0] in KNOWN else len(order), item[0]))


def section(folder: Folder, use: tuple[str, str], files: dict[str, list[Path]]) -> dict[str, Any]:
    """Template values of one use; its files are copied."""
    name, driver = use
    mark = "_".join(part for part in use if part)
    copied = {
        kind: [
            {
                "file": folder.copy(path, f"{mark}_{path.name}"),
                "name": words(path.stem),
                "source": f"{'/'.join(use).strip('/')}/{path.name}",
            }
            for path in files[kind]
        ]
        for kind in ("videos", "pictures")
    }
    for item, path in zip(copied["videos"], files["videos"], strict=True):
        item["comment"] = provenance.read_comment(path) or ""
    return {
        "id": mark,
        "title": f"{words(name)}: {driver}" if driver else words(name),
        "caption": KNOWN.get(name, ""),
        "reports": [{"name": path.name, "facts": facts(step.read_json(path))} for path in files["reports"]],
    } | copied


def run(job: step.Job) -> None:
    """Write the folder."""
    paths = {name: many(job.input, name) for name in ("videos", "pictures", "reports")}
    if not any(paths.values()):
        raise step.StepError(f"results/{job.subject}: there is no use to show; ask for one first, as in `snakemake orbit`")
    folder = Folder(job.output.page)
    sections = [section(folder, use, files) for use, files in grouped(paths)]
    variant = job.final.page.parent.name
    content = {"title": f"{job.subject}, {variant}: uses", "subject": job.subject, "variant": variant, "sections": sections}
    job.log.info("%s", folder.write(uses_template.PAGE, content))


if __name__ == "__main__":
    step.main(run, UsesConfig)
