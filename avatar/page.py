"""Step `page`: one HTML page of a subject in a folder with its videos and pictures; opens from disk and inside a report.

Input: probe, fit, overlay, frames, index, alpha (trim), and lists ordered by variant: renders, reports, videos, metrics,
per_frames, trains, plots. Output: page (folder with index.html).
"""

from __future__ import annotations

import json
import math
import shutil
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
import pandas as pd

from avatar import page_template, pictures
from avatar.config import PageConfig
from avatar.frames import chosen_frames
from avatar.results import by_variant, many
from workflow import step

WORST, PREVIEWS = 3, 3
COLUMNS = (("lpips", "LPIPS ↓", 3, min), ("ssim", "SSIM ↑", 3, max), ("psnr", "PSNR dB ↑", 2, max),
           ("l1", "L1 ↓", 4, min),
           ("iou", "mask IoU ↑", 3, max), ("psnr_face", "face PSNR ↑", 2, max),
           ("lpips_face", "face LPIPS ↓", 3, min))  # fmt: skip


def words(name: str) -> str:
    """`reprojection_percent` -> `reprojection percent`."""
    return name.replace("_", " ")


def shown(value: Any) -> str:
    """A JSON value in a few words: long lists become their length."""
    if value is None:
        return "not known"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.4g}" if math.isfinite(value) else str(value)
    if isinstance(value, dict):
        return ", ".join(f"{words(str(key))} {shown(item)}" for key, item in value.items())
    if isinstance(value, list):
        if not value:
            return "none"
        return ", ".join(shown(item) for item in value) if len(value) <= 6 else f"{len(value)} entries"
    return str(value)


def facts(content: dict[str, Any], without: tuple[str, ...] = ()) -> list[tuple[str, str]]:
    """Names and values of a JSON report, without its provenance."""
    return [(words(key), shown(value)) for key, value in content.items() if key not in ("provenance", *without)]


def score_rows(metrics: dict[str, dict]) -> list[dict[str, Any]]:
    """Rows of the table of scores: trained variants first; the best figure of a column, as shown, is marked."""
    order = sorted(metrics, key=lambda name: metrics[name]["predictor"])
    rows = [{"variant": name, "predictor": metrics[name]["predictor"], "cells": []} for name in order]
    for key, _, digits, end in COLUMNS:
        values = [metrics[name]["metrics"].get(key) for name in order]
        texts = [f"{value['mean']:.{digits}f}" if value else "no face" for value in values]
        best = end((text for text, value in zip(texts, values, strict=True) if value), key=float, default=None)
        for row, text, value in zip(rows, texts, values, strict=True):
            spread = f"{value['std']:.{digits}f}" if value else ""
            row["cells"].append({"value": text, "spread": spread, "best": text == best and len(rows) > 1})
    for row, name in zip(rows, order, strict=True):
        seconds = metrics[name].get("training_seconds")
        training = f"{seconds:.0f}" if seconds is not None else "not trained" if row["predictor"] else "not given"
        plain = (f"{metrics[name]['ms_per_frame']:.1f}", training, str(metrics[name]["scored_frames"]))
        row["cells"] += [{"value": value, "spread": "", "best": False} for value in plain]
    return rows


def tiles(metrics: dict[str, dict]) -> list[dict[str, str]]:
    """The figures of the trained variant with the least LPIPS; of a predictor where nothing was trained."""
    trained = [name for name in metrics if not metrics[name]["predictor"]] or list(metrics)
    name = min(trained, key=lambda item: metrics[item]["metrics"]["lpips"]["mean"])
    best = metrics[name]
    found = [
        {"value": f"{best['metrics'][key]['mean']:.{digits}f}", "label": f"{title} · {name}"}
        for key, title, digits, _ in COLUMNS[:3]
    ]
    found.append({"value": f"{best['ms_per_frame']:.0f} ms", "label": "render time a frame"})
    if best.get("training_seconds") is not None:
        found.append({"value": f"{best['training_seconds'] / 60:.1f} min", "label": "training time"})
    return [*found, {"value": str(best["scored_frames"]), "label": "test frames scored"}]


def ranked(table: pd.DataFrame) -> list[tuple[str, pd.Series]]:
    """The worst frames by LPIPS, the median one and the best, each once."""
    order = table.sort_values("lpips", ascending=False).reset_index(drop=True)
    places = {place: f"worst {place + 1}" for place in range(min(WORST, len(order)))}
    places.setdefault(len(order) // 2, "median")
    places.setdefault(len(order) - 1, "best")
    return [(rank, order.iloc[place]) for place, rank in places.items()]


class Folder:
    """The page's folder while it is made."""

    def __init__(self, path: Path) -> None:
        self.path = path
        path.mkdir(parents=True)

    def picture(self, name: str, image: np.ndarray, alt: str, caption: str) -> dict[str, Any]:
        """Write a picture; what the template needs to show it."""
        (self.path / name).write_bytes(pictures.png(image))
        return {"file": name, "alt": alt, "caption": caption, "width": image.shape[1], "height": image.shape[0]}

    def copy(self, source: Path, name: str) -> str:
        """Copy a file and return its name."""
        shutil.copyfile(source, self.path / name)
        return name


def strips(job: step.Job, folder: Folder, metrics: dict[str, dict], reports: dict[str, dict], time_s: list[float]) -> list[dict]:
    """Worst and best frames of every trained variant."""
    frames, alpha = (np.load(path, mmap_mode="r") for path in (job.input.frames, job.input.alpha))
    renders = by_variant(many(job.input, "renders"))
    groups = []
    for variant, path in by_variant(many(job.input, "per_frames")).items():
        if metrics[variant]["predictor"]:
            continue
        render, group = np.load(renders[variant], mmap_mode="r"), []
        for rank, row in ranked(pd.read_csv(path)):
            frame = int(row["frame"])
            image = pictures.scored_strip(frames[frame], alpha[frame], render[reports[variant]["frames"].index(frame)])
            caption = (f"frame {frame} at {time_s[frame]:.1f} s, LPIPS {row['lpips']:.3f}, SSIM {row['ssim']:.3f}, "
                       f"PSNR {row['psnr']:.2f} dB")  # fmt: skip
            alt = f"frame {frame}: input, render of {variant} and error map"
            group.append(folder.picture(f"{variant}_{rank.replace(' ', '')}.png", image, alt, caption) | {"rank": rank})
        groups.append({"variant": variant, "strips": group})
    return groups


def trim_previews(job: step.Job, folder: Folder, time_s: list[float]) -> list[dict]:
    """A few frames, evenly spaced over the clip, with their trimmed alpha."""
    frames, alpha = (np.load(path, mmap_mode="r") for path in (job.input.frames, job.input.alpha))
    previews = []
    for frame in chosen_frames(list(range(len(frames))), PREVIEWS):
        image = pictures.trim_strip(frames[frame], alpha[frame])
        alt = f"frame {frame}: as filmed, opacity, on white"
        previews.append(folder.picture(f"trim_{frame:05d}.png", image, alt, f"frame {frame} at {time_s[frame]:.1f} s"))
    return previews


def stages_of(documents: dict[str, dict]) -> list[dict[str, Any]]:
    """Seconds of each stage that says them (of all parts of a resumed training), with a bar in percent of the longest."""
    seconds = {
        name: document.get("train_seconds", document["provenance"]["seconds"])
        for name, document in documents.items()
        if "provenance" in document
    }
    longest = max(seconds.values(), default=0) or 1
    return [
        {"name": name, "seconds": f"{value:.1f}", "percent": f"{100 * value / longest:.1f}"} for name, value in seconds.items()
    ]


def _documents(job: step.Job) -> dict[str, dict]:
    """Every JSON report by stage name, in the order of the pipeline; that of a variant as `train demo`."""
    found = {
        "probe": step.read_json(job.input.probe),
        "extract": step.read_json(job.input.index),
        "fit": step.read_json(job.input.fit),
    }
    for stage, name in (("train", "trains"), ("render", "reports"), ("evaluate", "metrics")):
        found |= {f"{stage} {variant}": step.read_json(path) for variant, path in by_variant(many(job.input, name)).items()}
    return found


def _reproduce(documents: dict[str, dict]) -> dict[str, Any]:
    """Template values that say what made the results."""
    known = {name: document["provenance"] for name, document in documents.items() if "provenance" in document}
    versions: dict[str, str] = {}
    for item in known.values():
        versions |= item["versions"]
    machines = dict.fromkeys(f"{item['device']}, {item['threads']} threads" for item in known.values())
    stages = []
    for name, item in known.items():
        config = json.dumps(item["config"], indent=1, ensure_ascii=False)
        stages.append({"name": name, "code": item["code"] or "not recorded", "config": config})
    return {
        "provenance": stages,
        "versions": sorted(versions.items()),
        "machine": f"Wall-clock seconds on: {'; '.join(machines)}. A training that was resumed counts all its parts.",
    }


def _fitted(documents: dict[str, dict]) -> dict[str, Any]:
    """Template values on the video and its fit."""
    probe, fit = documents["probe"], documents["fit"]
    return {
        "unknown": fit.get("not_determined", []),
        "decisions": facts(fit.get("decisions", {})),
        "fit": facts(fit, ("not_determined", "decisions")),
        "warnings": probe.get("warnings", []),
        "probe": facts(probe, ("warnings", "reason")),
        "source": probe.get("file", "the video"),
    }


def _scored(metrics: dict[str, dict], frames: int) -> dict[str, Any]:
    """Template values on the scores; `frames` is the length of the clip."""
    rows = score_rows(metrics)
    first = metrics[rows[0]["variant"]]
    lost, resolution = first["excluded"], first["protocol"]["resolution"].replace("x", " × ")
    left_out = (
        f"Rendered frames left out: {lost['count']}, {lost['reason']}." if lost["count"] else "No rendered frame is left out."
    )
    return {
        "summary": f"{frames} frames at {resolution} px, {first['test_frames']} test frames rendered",
        "tiles": tiles(metrics),
        "columns": [*(title for _, title, _, _ in COLUMNS), "render ms", "training s", "frames"],
        "rows": rows,
        "excluded": left_out,
        "protocol": facts(first["protocol"]),
    }


def content(job: step.Job, folder: Folder) -> dict[str, Any]:
    """Everything that the template shows; pictures and videos are written on the way."""
    documents = _documents(job)
    stages: dict[str, dict[str, dict]] = {"train": {}, "render": {}, "evaluate": {}}
    for name, document in documents.items():
        stage, _, variant = name.partition(" ")
        if variant:
            stages[stage][variant] = document
    if not stages["evaluate"]:
        raise step.StepError(f"results/{job.subject}: there are no scores to show; run snakemake first")
    time_s = documents["extract"]["time_s"]
    scored = _scored(stages["evaluate"], len(time_s))
    paths, videos = by_variant(many(job.input, "videos")), []
    for row in scored["rows"]:
        file = folder.copy(paths[row["variant"]], f"{row['variant']}.mp4")
        videos.append({"variant": row["variant"], "predictor": row["predictor"], "lead": not videos, "file": file})
    folder.copy(job.input.overlay, "overlay.mp4")
    return (
        {
            "subject": job.subject,
            "style": page_template.STYLE,
            "error_range": f"{pictures.ERROR_RANGE:g}",
            "videos": videos,
            "groups": strips(job, folder, stages["evaluate"], stages["render"], time_s),
            "plots": [{"file": folder.copy(path, path.name), "alt": f"{path.stem} plot"} for path in many(job.input, "plots")],
            "trims": trim_previews(job, folder, time_s),
            "stages": stages_of(documents),
            "trainings": [{"variant": name, "facts": facts(item)} for name, item in stages["train"].items()],
        }
        | scored
        | _fitted(documents)
        | _reproduce(documents)
    )


def run(job: step.Job) -> None:
    """Write the folder."""
    folder = Folder(job.output.page)
    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined)
    text = environment.from_string(page_template.PAGE).render(content(job, folder))
    (folder.path / "index.html").write_text(text, encoding="utf-8")
    size = sum(path.stat().st_size for path in folder.path.iterdir())
    job.log.info("page of %d files, %.1f MB", len(list(folder.path.iterdir())), size / 1e6)


if __name__ == "__main__":
    step.main(run, PageConfig)
