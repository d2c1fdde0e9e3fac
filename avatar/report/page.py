"""Step `page`: one HTML page of a subject in a folder with its player and pictures; opens from disk and inside a report.

Input: probe, fit, overlay, frames, index, alpha (trim), and lists ordered by variant: renders, reports, videos (for what
their containers say of them), metrics, per_frames, trains, plots. Output: page, a folder with index.html, and card.jpg for the
page of all subjects.
"""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pandas as pd

from avatar import provenance
from avatar.frames import chosen_frames
from avatar.report import page_scores, page_template, pictures, player
from avatar.report.config import PageConfig
from avatar.report.page_parts import Folder, facts
from avatar.report.results import by_variant, many
from workflow import step

PREVIEWS = 3
CARD_PX = 300


def strips(job: step.Job, folder: Folder, metrics: dict[str, dict], reports: dict[str, dict], time_s: list[float]) -> list[dict]:
    """Worst and best frames of every trained variant."""
    frames, alpha = (np.load(path, mmap_mode="r") for path in (job.input.frames, job.input.alpha))
    renders = by_variant(many(job.input, "renders"))
    groups = []
    for variant, path in by_variant(many(job.input, "per_frames")).items():
        if metrics[variant]["predictor"]:
            continue
        render, group = np.load(renders[variant], mmap_mode="r"), []
        for rank, row in page_scores.ranked(pd.read_csv(path)):
            frame = int(row["frame"])
            image = pictures.scored_strip(frames[frame], alpha[frame], render[reports[variant]["frames"].index(frame)])
            caption = (f"frame {frame} at {time_s[frame]:.1f} s, LPIPS {row['lpips']:.3f}, SSIM {row['ssim']:.3f}, "
                       f"PSNR {row['psnr']:.2f} dB")  # fmt: skip
            alt = f"frame {frame}: input, render of {variant} and error map"
            group.append(
                folder.picture(f"{variant}_{rank.replace(' ', '')}.png", image, alt, caption) | {"rank": rank, "frame": frame}
            )
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
    first = metrics[page_scores.ordered(metrics)[0]]
    lost, resolution = first["excluded"], first["protocol"]["resolution"].replace("x", " × ")
    left_out = (
        f"Rendered frames left out: {lost['count']}, {lost['reason']}." if lost["count"] else "No rendered frame is left out."
    )
    noun = "test frame" if first["test_frames"] == 1 else "test frames"
    return {
        "summary": f"{frames} frames at {resolution} px, {first['test_frames']} {noun} rendered",
        "tiles": page_scores.tiles(metrics),
        "tables": page_scores.tables(metrics),
        "excluded": left_out,
        "protocol": facts(first["protocol"]),
    }


def write_player(
    job: step.Job, folder: Folder, metrics: dict[str, dict], reports: dict[str, dict], index: dict
) -> dict[str, Any]:
    """Write the player's video and a card; the template's values on the player. Trained variants come first."""
    frames, alpha = (np.load(path, mmap_mode="r") for path in (job.input.frames, job.input.alpha))
    paths, names = by_variant(many(job.input, "renders")), page_scores.ordered(metrics)
    renders = {name: np.load(paths[name], mmap_mode="r") for name in names}
    reports = {name: reports[name] for name in names}
    tables = {name: pd.read_csv(by_variant(many(job.input, "per_frames"))[name]) for name in names}
    videos = by_variant(many(job.input, "videos"))
    comments = [f"{name}: {comment}" for name in names if (comment := provenance.read_comment(videos[name]))]
    comment = " | ".join(comments) or "synthetic: rendered by trained head avatars beside the filmed input"
    tiling = player.Tiling.of(1 + len(names), frames.shape[1:3])
    rate = player.rate(player.shown_frames(reports), index["fps"])
    predictors = [name for name in names if metrics[name]["predictor"]]
    content = player.data(tiling, rate, index["time_s"], reports, predictors, tables)
    tiles = player.tiled(frames, alpha, renders, reports, tiling)
    player.write_video(folder.path / "player.mp4", job.progress(tiles, "player", len(content["frames"])), rate, comment)
    best = page_scores.lead(metrics)
    middle = int(tables[best].sort_values("lpips").iloc[len(tables[best]) // 2]["frame"])
    small = pictures.card(frames[middle], alpha[middle], renders[best][reports[best]["frames"].index(middle)], CARD_PX)
    (folder.path / "card.jpg").write_bytes(pictures.jpeg(small))
    order = ", ".join(panel["name"] for panel in content["panels"])
    return {"file": "player.mp4", "data": content, "order": order, "comment": " ".join(comments)}


def decisions_of(training: dict[str, Any]) -> list[tuple[str, str]]:
    """What `train.budget` decided: the decision, and what was taken with its reason."""
    rows = training.get("budget", {}).get("decisions", [])
    return [(row["decision"], f"{row['taken']}: {row['reason']}") for row in rows]


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
    folder.copy(job.input.overlay, "overlay.mp4")
    return (
        {
            "title": f"{job.subject}: head avatar",
            "subject": job.subject,
            "player": write_player(job, folder, stages["evaluate"], stages["render"], documents["extract"]),
            "error_range": f"{pictures.ERROR_RANGE:g}",
            "groups": strips(job, folder, stages["evaluate"], stages["render"], time_s),
            "plots": [{"file": folder.copy(path, path.name), "alt": f"{path.stem} plot"} for path in many(job.input, "plots")],
            "trims": trim_previews(job, folder, time_s),
            "stages": stages_of(documents),
            "trainings": [
                {"variant": name, "facts": facts(item, ("budget",)), "decisions": decisions_of(item)}
                for name, item in stages["train"].items()
            ],
        }
        | _scored(stages["evaluate"], len(time_s))
        | _fitted(documents)
        | _reproduce(documents)
    )


def run(job: step.Job) -> None:
    """Write the folder."""
    folder = Folder(job.output.page)
    job.log.info("%s", folder.write(page_template.PAGE, content(job, folder)))


if __name__ == "__main__":
    step.main(run, PageConfig)
