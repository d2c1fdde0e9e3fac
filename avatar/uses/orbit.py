"""Step `orbit`: the camera on an arc around the head, colour beside depth and normals (the paper's figure of driving).

Input: head avatar frames track split index. Output: video, sheet (5 views), report.
The head is held straight before the camera, so that the views are angles to the face itself. With a frozen expression the camera
goes from side to side and then up and down, and each view is rendered once; else the expressions of the test frames play.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from avatar.frames import chosen_frames
from avatar.report.pictures import png
from avatar.uses import choose, motion, sequence, shading, studio
from avatar.uses.config import OrbitConfig
from avatar.uses.sequence import Picture
from fitting.video import write_video
from workflow import step

FPS = 12.0
"""Of a frozen expression."""
UPWARDS = 0.3
"""Part of the views that goes up and down."""


def arc(views: int, yaw_rad: float, pitch_rad: float) -> tuple[np.ndarray, np.ndarray, list[int]]:
    """Views of a frozen expression and the order in which they are shown.

    Returns:
        yaw [V] and pitch [V] rad, V the largest odd number up to `views`: from side to side, then down and up; the middle once.
        places to show: left and right, back to the middle, up and down, back to the middle; a loop.
    """
    views -= 1 - views % 2
    half = max(1, round(UPWARDS * views / 2))  # views on the way up
    across = views - 2 * half
    middle = across // 2
    yaw, pitch = np.zeros(views), np.zeros(views)
    yaw[:across] = np.linspace(-yaw_rad, yaw_rad, across)
    pitch[across:] = np.delete(np.linspace(-pitch_rad, pitch_rad, 2 * half + 1), half)
    column = [*range(across, across + half), middle, *range(across + half, views)]
    sides = [*range(middle, across), *range(across - 2, -1, -1), *range(1, middle)]
    heights = [*column[half:], *column[-2::-1], *column[1:half]]
    return yaw, pitch, sides + heights


def playing(views: int, yaw_rad: float, pitch_rad: float) -> tuple[np.ndarray, np.ndarray]:
    """Views [views] rad of a playing expression: one turn around an ellipse, beginning and ending in the middle of its top."""
    turn = np.linspace(0, 2 * np.pi, views)
    return yaw_rad * np.sin(turn), pitch_rad * np.cos(turn)


def run(job: step.Job) -> None:
    """Render the views and write video, sheet of five views and report."""
    room, config = studio.open_studio(job), job.config
    frames, looks = _looks(room)
    limits = np.radians([config.yaw_degrees, config.pitch_degrees])
    if config.playing:
        shown = chosen_frames(frames, config.views)
        yaw, pitch = playing(len(shown), *limits)
        order, fps = list(range(len(shown))), max(1.0, room.fps * len(shown) / len(frames))
        moved = room.motion(shown)
    else:
        frame = config.frame if config.frame is not None else frames[choose.calm(looks)]
        if frame >= len(room.track["expression"]):
            raise step.StepError(f"orbit.frame: there is no frame {frame}; the clip has {len(room.track['expression'])}")
        shown, fps = [frame], FPS
        yaw, pitch, order = arc(config.views, *limits)
        moved = motion.held(room.motion(shown), 0, len(yaw))
    scene = room.scene(studio.frontal(room, moved))
    scene.offset_m[:, :2] -= sequence.head_centre_m(scene)[:, :2]  # on the camera's axis: then the views are the angles asked for
    sequence.turn(scene, sequence.viewpoint(yaw, pitch), sequence.head_centre_m(scene))
    camera = sequence.framed(scene, config.size, room.clearance_m())
    pictures = list(room.render(job, scene, range(len(yaw)), camera.size))
    angles, seen = np.degrees(sequence.camera_angles(scene)), studio.training_angles(room)
    panels = Panels(pictures, camera, named(angles, beyond(angles, seen)))
    write_video(job.output.video, (panels.row(place) for place in order), fps, room.comment)
    columns = [panels.column(place) for place in five(yaw, pitch)]
    job.output.sheet.write_bytes(png(shading.grid(list(zip(*columns, strict=True)))))
    job.write_json(
        job.output.report,
        room.report(pictures)
        | {
            "frames": shown,
            "expression": "playing" if config.playing else "frozen",
            "views": [{"yaw_degrees": round(y, 1), "pitch_degrees": round(p, 1)} for y, p in angles.T.tolist()],
            "order": order,
            "fps": round(fps, 3),
            "depth_m": [round(end, 4) for end in panels.range_m],
            "training_saw": seen,
            "views_beyond_training": int(beyond(angles, seen).sum()),
        },
    )
    job.log.info("%d views, %d beyond what training saw (%s)", len(yaw), beyond(angles, seen).sum(), seen)


def _looks(room: studio.Studio) -> tuple[list[int], choose.Looks]:
    """The usable test frames and what they show."""
    frames = room.test_frames()
    moved = room.motion(frames)
    return frames, choose.looks_of(room.scene(moved), moved.eyes)


def beyond(angles: np.ndarray, seen: dict[str, list[float]]) -> np.ndarray:
    """angles: [2, T] degrees of yaw and pitch; seen: their ends in training. Returns bool [T], outside of either."""
    ends = np.array([seen["yaw_degrees"], seen["pitch_degrees"]])[..., None]
    return ((angles < ends[:, 0]) | (angles > ends[:, 1])).any(0)


def five(yaw: np.ndarray, pitch: np.ndarray) -> list[int]:
    """Places of the middle view and of those farthest to the subject's right, to its left, up and down."""
    middle = int(np.hypot(yaw, pitch).argmin())
    return [int(yaw.argmin()), middle, int(yaw.argmax()), int(pitch.argmax()), int(pitch.argmin())]


def named(angles: np.ndarray, unseen: np.ndarray) -> list[str]:
    """A caption for each view: angles [2, T] degrees; unseen: [T] bool, beyond what training saw."""
    words = [f"yaw {round(yaw):+d}, pitch {round(pitch):+d}" for yaw, pitch in angles.T.tolist()]
    return [text + (", unseen" if new else "") for text, new in zip(words, unseen, strict=True)]


class Panels:
    """Colour, depth and normals of pictures that share one scale of depth."""

    def __init__(self, pictures: Sequence[Picture], camera: sequence.Camera, names: Sequence[str]) -> None:
        self.pictures, self.camera, self.names = pictures, camera, names
        self.range_m = shading.depth_range([p.depth_m for p in pictures], [p.image[..., 3] for p in pictures])

    def parts(self, place: int) -> list[np.ndarray]:
        """Three images uint8 [H, W, 3]."""
        picture = self.pictures[place]
        opacity = picture.image[..., 3]
        depth = shading.depth_picture(picture.depth_m, opacity, *self.range_m)
        normal = shading.normals(picture.depth_m, opacity, self.camera.focal_px, self.camera.centre_px)
        return [picture.image[..., :3], depth, shading.normal_picture(normal)]

    def row(self, place: int) -> np.ndarray:
        """A frame of the video [H', 3 W, 3]: the three beside each other with captions and the scale of depth."""
        colour, depth, normal = self.parts(place)
        blank = shading.with_bar(normal, "right: red", "up: green", np.full((2, 3), 255, np.uint8))
        below = shading.with_depth_bar(depth, *self.range_m)
        colour = np.pad(colour, ((0, len(below) - len(colour)), (0, 0), (0, 0)), constant_values=255)
        parts = zip((colour, below, blank), (self.names[place], "depth", "normals"), strict=True)
        return np.concatenate([shading.captioned(image, text) for image, text in parts], 1)

    def column(self, place: int) -> list[np.ndarray]:
        """A column of the sheet: one view."""
        colour, depth, normal = self.parts(place)
        return [
            shading.captioned(colour, self.names[place]),
            shading.with_depth_bar(shading.captioned(depth, "depth"), *self.range_m),
            shading.captioned(normal, "normals"),
        ]


if __name__ == "__main__":
    step.main(run, OrbitConfig)
