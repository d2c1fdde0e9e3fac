"""Step `sheet`: what an avatar makes of some frames, and of what it was given: seven pictures a frame, at the frames' own pixels.

Input: head avatar frames alpha track split index. Output: sheet (all frames), folder (one PNG a frame), report.
"""

from __future__ import annotations

import numpy as np

from avatar.dataset import Scene
from avatar.report.pictures import error_map, on_white, png
from avatar.uses import choose, shading, studio
from avatar.uses.config import SheetConfig
from avatar.uses.extrapolate import head_box
from avatar.uses.sequence import Camera, Picture
from fitting import extract
from fitting.overlay import draw_mesh
from workflow import step

LONGEST_PX = 4096


def run(job: step.Job) -> None:
    """Render the frames and write a PNG of each and of all."""
    room, config = studio.open_studio(job), job.config
    frames, alpha = (np.load(path, mmap_mode="r") for path in (job.input.frames, job.input.alpha))
    named = chosen(room, config.frames)
    wanted = list(named)
    box, size, _ = extract.fit_crop(head_box(alpha, wanted), config.size or LONGEST_PX)
    camera = room.camera.window(box, size)
    scene = room.scene(room.motion(wanted), camera)
    pictures = list(room.render(job, scene, range(len(wanted)), size))
    near_far = shading.depth_range([p.depth_m for p in pictures], [p.image[..., 3] for p in pictures])
    job.output.folder.mkdir(parents=True)
    rows = []
    for place, (frame, picture) in enumerate(zip(wanted, pictures, strict=True)):
        given = [extract.cut(image, box, size) for image in (on_white(frames[frame], alpha[frame]), frames[frame])]
        rows.append(row(given, picture, scene, place, camera, near_far, f"frame {frame}: {named[frame]}"))
        (job.output.folder / f"frame_{frame:05d}.png").write_bytes(png(shading.grid([rows[-1]])))
    job.output.sheet.write_bytes(png(shading.grid(rows)))
    errors = [
        error(picture, extract.cut(on_white(frames[f], alpha[f]), box, size)) for f, picture in zip(wanted, pictures, strict=True)
    ]
    job.write_json(
        job.output.report,
        room.report(pictures)
        | {
            "frames": [
                {
                    "frame": frame,
                    "shows": named[frame],
                    "part": part_of(room, frame),
                    "l1": value,
                    "ms": round(picture.milliseconds, 1),
                }
                for frame, value, picture in zip(wanted, errors, pictures, strict=True)
            ],
            "depth_m": [round(end, 4) for end in near_far],
            "crop": box,
            "l1": "mean absolute error over RGB in [0, 1] inside this crop: for the eye; figures for tables come from `evaluate`",
        },
    )
    job.log.info("%d frames at %dx%d", len(wanted), size[1], size[0])


def chosen(room: studio.Studio, asked: tuple[int, ...]) -> dict[int, str]:
    """Frames and what each shows; StepError for one that the clip does not have."""
    count = len(room.track["expression"])
    for frame in asked:
        if not 0 <= frame < count:
            raise step.StepError(f"sheet.frames: there is no frame {frame}; the clip has {count}")
    if asked:
        return {frame: part_of(room, frame) for frame in asked}
    test = room.test_frames()
    moved = room.motion(test)
    found = choose.telling(choose.looks_of(room.scene(moved), moved.eyes))
    return {test[place]: words for place, words in found.items()}


def part_of(room: studio.Studio, frame: int) -> str:
    """Which part of the split a frame belongs to: an error on a training frame says less."""
    parts = [name for name in ("train", "test") if frame in room.split[name]]
    return {"train": "training frame", "test": "test frame"}[parts[0]] if parts else "in neither part"


def row(
    given: list[np.ndarray],
    picture: Picture,
    scene: Scene,
    place: int,
    camera: Camera,
    near_far: tuple[float, float],
    title: str,
) -> list[np.ndarray]:
    """Seven captioned images of one frame; given: the input on white and as filmed, uint8 [H, W, 3]."""
    truth, filmed = given
    colour, opacity = picture.image[..., :3], picture.image[..., 3]
    vertices = scene.vertices_m[place].double().numpy() @ scene.rotation[place].T + scene.offset_m[place]
    mesh = draw_mesh(filmed, vertices, scene.head.triangles.numpy(), camera.focal_px, camera.centre_px)
    depth = shading.depth_picture(picture.depth_m, opacity, *near_far)
    normal = shading.normals(picture.depth_m, opacity, camera.focal_px, camera.centre_px)
    return [
        shading.captioned(truth, title),
        shading.captioned(colour, "render"),
        shading.with_error_bar(shading.captioned(error_map(colour, truth), "absolute error, mean of R, G, B")),
        shading.with_depth_bar(shading.captioned(depth, "depth"), *near_far),
        shading.captioned(shading.normal_picture(normal), "normals: right red, up green"),
        shading.captioned(mesh, "tracked mesh on input"),
        shading.captioned(shading.opacity_picture(opacity), "opacity"),
    ]


def error(picture: Picture, truth: np.ndarray) -> float:
    """Mean absolute error of a render against the input on white, uint8 [H, W, 3]."""
    return round(float(np.abs(picture.image[..., :3].astype(np.float64) - truth).mean() / 255), 5)


if __name__ == "__main__":
    step.main(run, SheetConfig)
