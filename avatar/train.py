"""train: fit an avatar to the training frames. One visible loop; interrupted runs continue at their step, to the bit on CPU."""

from __future__ import annotations

import resource
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor, nn

from avatar import build, checkpoint, coverage, losses, shell
from avatar.checkpoint import BAD_WINDOW, State
from avatar.config import TrainConfig
from avatar.dataset import Cells, Scene, cells_of, draw, on_white, shrink_any
from avatar.layers import best_precision
from fitting.files import load_head
from fitting.head_model import HeadModel
from fitting.raster import vertex_normals
from workflow import step

CHECKPOINT_S = 60.0
PROBE_FRAMES = 3  # training frames that are held out to watch progress
PROBES = 10  # times the curve is measured
PROBE_STRIDE = 4
LOOKED_AT = 24  # training frames whose mattes shape the shell
BAD_SHARE = 0.01  # of the last BAD_WINDOW steps


class TrainingFailed(step.StepError):
    """The data or the settings do not let this avatar be trained; another try would end the same way."""


@dataclass
class Data:
    """Everything a step of training reads; frames stay on disk."""

    head: HeadModel
    scene: Scene
    frames: np.ndarray  # [T, H, W, 3] uint8, memory-mapped
    alpha: np.ndarray  # [T, H, W] uint8, memory-mapped
    train: list[int]
    probe: list[int]


def load(job: step.Job) -> Data:
    """Read the inputs; StepError names what does not fit together."""
    head = load_head(job.input.head)
    try:
        with np.load(job.input.track, allow_pickle=False) as file:
            track = {name: file[name] for name in file.files}
    except (ValueError, OSError, KeyError) as error:
        raise step.StepError(f"{job.input.track}: {error}") from error
    frames, alpha = np.load(job.input.frames, mmap_mode="r"), np.load(job.input.alpha, mmap_mode="r")
    for path, pixels in ((job.input.frames, frames), (job.input.alpha, alpha)):
        if pixels.dtype != np.uint8:
            raise step.StepError(f"{path}: pixels of type {pixels.dtype}, expected uint8; run snakemake again")
    usable = track.get("usable", np.ones(len(frames), bool))
    train = [frame for frame in step.read_json(job.input.split)["train"] if usable[frame]]
    if len(train) < 2:
        raise step.StepError(f"{job.input.track}: {len(train)} usable training frames; training needs at least 2")
    if frames.shape[:3] != alpha.shape:
        raise step.StepError(f"{job.input.alpha}: {alpha.shape}, the frames are {frames.shape[:3]}; run snakemake again")
    held = (
        {train[int(i)] for i in np.linspace(0, len(train), PROBE_FRAMES + 2)[1:-1]} if len(train) >= 4 * PROBE_FRAMES else set()
    )
    try:
        scene = Scene(head, track, train)
    except ValueError as error:
        raise step.StepError(f"{job.input.track}: {error}; fit the clip again") from error
    return Data(head, scene, frames, alpha, [frame for frame in train if frame not in held], sorted(held) or train[:1])


def preflight(job: step.Job, data: Data) -> float:
    """Stop before hours of training when the mesh does not lie on the person. Returns the median overlap."""
    chosen = data.train[:: max(1, len(data.train) // 8)]
    found = float(np.median([coverage.overlap(data.scene, data.alpha[frame], frame) for frame in chosen]))
    if found < coverage.PREFLIGHT_OVERLAP:
        raise TrainingFailed(
            f"{job.input.track}: the fitted mesh covers the matte with an overlap of only {found:.2f} (at least "
            f"{coverage.PREFLIGHT_OVERLAP} is needed); look at fit/overlay.mp4 and trim/alpha.npy"
        )
    return found


def make_avatar(job: step.Job, data: Data) -> nn.Module:
    """A fresh avatar whose shell fits the mattes."""
    torch.manual_seed(job.config.seed)
    avatar = build.build(build.settings_of(job.config), data.head)
    looked_at = data.train[:: max(1, len(data.train) // LOOKED_AT)]
    neutral, triangles = data.scene.neutral_m.numpy().astype(np.float64), data.head.triangles.numpy()
    base = coverage.base_thickness(data.head.region.numpy(), neutral, triangles)
    thickness = coverage.measured_thickness(data.scene, data.alpha, looked_at, base)
    core = shell.core_points(neutral, vertex_normals(neutral, triangles))
    avatar.shape_shell(torch.from_numpy(thickness), torch.from_numpy(core))
    if job.config.warp:
        avatar.correct_errors(len(data.scene.frames))
    job.log.info("shell: %.0f to %.0f mm, median %.0f mm", *(1000 * np.quantile(thickness, (0, 1, 0.5))))
    return avatar.to(job.device)


def make_optimiser(config: TrainConfig, avatar: nn.Module) -> torch.optim.Optimizer:
    """Adam (paper, supplement B) with a group of parameters for each entry of `losses.RATES` that the avatar has."""
    groups: dict[str, list[nn.Parameter]] = {}
    for name, parameter in avatar.named_parameters():
        groups.setdefault(losses.group_of(name), []).append(parameter)
    chosen = [{"params": parameters, "name": name} for name, parameters in groups.items()]
    return torch.optim.Adam(chosen, lr=config.learning_rate, betas=(0.9, 0.999), fused=True)


class Batches:
    """Rays and colours of a step, a pure function of the seed and the step's number."""

    def __init__(self, config: TrainConfig, data: Data, avatar: nn.Module) -> None:
        self.config, self.data, self.avatar = config, data, avatar
        self.cells: dict[int, Cells] = {}

    def posed(self, frames: list[int], device: str, training: bool = True):  # noqa: ANN201 - whatever `pose` returns
        """The posed heads of some frames; also finds where their rays are drawn when a frame is new."""
        posed = self.avatar.pose(*self.data.scene.heads(frames, device, training))
        for place, frame in enumerate(frames):
            if frame not in self.cells:
                self.cells[frame] = self._cells(frame, posed.grids[place] if posed.grids else None)
        return posed

    def _cells(self, frame: int, grid: shell.Grid | None) -> Cells:
        """Where rays of a frame are drawn: where they meet the shell; anywhere when there is none."""
        size = self.data.alpha.shape[1:]
        near = ndimage.binary_dilation(shrink_any(self.data.alpha[frame]), iterations=2)
        hit = np.ones_like(near) if grid is None else coverage.hit_blocks(grid, self.data.scene, frame, size)
        return cells_of(ndimage.binary_dilation(hit), near, coverage.feature_blocks(self.data.scene, frame, size))

    def at(self, number: int, device: str):  # noqa: ANN201
        """Frames, posed heads, rays, jitter and truth [N, 4] (colour on white, opacity) of step `number`."""
        random = np.random.default_rng([self.config.seed, number])
        count = min(self.config.frames_per_step, len(self.data.train))
        frames = [self.data.train[i] for i in random.choice(len(self.data.train), count, replace=False)]
        posed = self.posed(frames, device)
        rays, jitter, truth = [], [], []
        for frame in frames:
            columns, rows = draw(self.cells[frame], max(1, self.config.rays // count), self.data.alpha.shape[1:], random)
            rays.append(self.data.scene.rays(frame, columns, rows))
            alpha = self.data.alpha[frame][rows, columns]
            truth.append(
                np.concatenate([on_white(self.data.frames[frame][rows, columns], alpha), alpha[:, None] / np.float32(255)], 1)
            )
            jitter.append(random.random((len(columns), self.avatar.jitter_width), dtype=np.float32))
        return frames, posed, rays, jitter, torch.from_numpy(np.concatenate(truth)).to(device)


@torch.no_grad()
def probe_psnr(batches: Batches, precision: torch.dtype, device: str) -> float:
    """Mean PSNR in dB over the held-out training frames, on every PROBE_STRIDE-th pixel."""
    data, values = batches.data, []
    for frame in data.probe:
        image = on_white(data.frames[frame][::PROBE_STRIDE, ::PROBE_STRIDE], data.alpha[frame][::PROBE_STRIDE, ::PROBE_STRIDE])
        rows, columns = np.mgrid[: image.shape[0], : image.shape[1]] * PROBE_STRIDE
        rays = data.scene.rays(frame, columns.ravel(), rows.ravel())
        colour = batches.avatar.march(batches.posed([frame], device, training=False), rays, precision)[0].colour.cpu()
        values.append(losses.psnr(colour, torch.from_numpy(image.reshape(-1, 3))))
    return float(np.mean(values))


def verdict(loss: Tensor, parameters: list[nn.Parameter], evaluations: int) -> str:
    """What is wrong with a step after its backward pass, or an empty string. evaluations: of the field, 0 when no ray met it.

    Dead: most parameters get no gradient at all, which is how a network whose units have all died by too large steps looks
    (seen at a learning rate of 3e-3: everything turns white and stays so).
    """
    gradients = [parameter.grad for parameter in parameters if parameter.grad is not None]
    largest = torch.stack(torch._foreach_norm(gradients, float("inf"))) if gradients else loss.new_zeros(1)
    if not (torch.isfinite(loss) and torch.isfinite(largest).all()):
        return "a loss or gradient that is not finite"
    return "no gradient at all: the network is dead" if evaluations and (largest == 0).float().mean() > 0.5 else ""


def optimise(job: step.Job, batches: Batches, optimiser: torch.optim.Optimizer, state: State, precision: torch.dtype) -> float:
    """One step of training. Returns the loss."""
    config, parameters = job.config, [p for group in optimiser.param_groups for p in group["params"]]
    frames, posed, rays, jitter, truth = batches.at(state.step, job.device)
    window = losses.warp_window(state.step, config.steps) if losses.warp_on(state.step, config.steps) else None
    outcome = batches.avatar.render(posed, rays, precision, jitter, window)
    loss = sum(losses.weight_of(name, state.step, config.steps) * value for name, value in outcome.terms.items())
    squared = state.step < losses.squared_until(config.steps, config.sampling == "hierarchical")
    for rendered in outcome.renders:
        loss = loss + losses.photometric(rendered.colour, truth[:, :3], squared)
        loss = loss + config.opacity_weight * losses.opacity(rendered.opacity, truth[:, 3])
    for group in optimiser.param_groups:
        group["lr"] = losses.RATES[group["name"]] * losses.learning_rate(config.learning_rate, state.step, config.steps)
    optimiser.zero_grad(set_to_none=True)
    loss.backward()
    wrong = verdict(loss.detach(), parameters, outcome.evaluations)
    if not wrong and outcome.evaluations:  # where no ray meets the head there is nothing to learn, and momentum does not go on
        optimiser.step()
    state.step, state.skipped, state.evaluations = (
        state.step + 1,
        state.skipped + bool(wrong),
        state.evaluations + outcome.evaluations,
    )
    state.recent.append(bool(wrong))
    if sum(state.recent) > BAD_SHARE * BAD_WINDOW:
        raise TrainingFailed(
            f"training diverges at step {state.step}: {sum(state.recent)} of the last {len(state.recent)} steps had {wrong}, "
            f"the last on frames {frames}; lower train.learning_rate"
        )
    return float(loss.detach())


def loop(job: step.Job, batches: Batches, optimiser: torch.optim.Optimizer, state: State, path: Path, mark: str) -> None:
    """Train to the last step, with a checkpoint every minute and when interrupted."""
    config, precision = job.config, best_precision(job.device)
    started, before = time.perf_counter(), state.seconds
    saved, every = started, max(1, config.steps // PROBES)
    with checkpoint.deferred_interrupts() as interrupted:
        for _ in job.progress(range(state.step, config.steps), "training"):
            state.losses.append(optimise(job, batches, optimiser, state, precision))
            state.seconds = before + time.perf_counter() - started
            if state.step % every == 0 or state.step == config.steps:
                quality = probe_psnr(batches, precision, job.device)
                state.curve.append([state.step, state.seconds, float(np.mean(state.losses)), quality])
                job.log.info("step %d: loss %.4f, probe %.2f dB, %.0f s", *(state.curve[-1][i] for i in (0, 2, 3, 1)))
                state.losses = []
            if interrupted or time.perf_counter() - saved > CHECKPOINT_S:
                checkpoint.save(path, mark, state, batches.avatar, optimiser)
                saved = time.perf_counter()
            if interrupted:
                raise KeyboardInterrupt
    checkpoint.save(path, mark, state, batches.avatar, optimiser)


def run(job: step.Job) -> None:
    """Inputs head frames alpha track split; outputs avatar curve report."""
    data = load(job)
    found = preflight(job, data)
    avatar = make_avatar(job, data)
    optimiser = make_optimiser(job.config, avatar)
    path, mark = job.final.avatar.parent / "checkpoints" / "last.pt", checkpoint.fingerprint(job)
    state = checkpoint.resume(job, path, mark, avatar, optimiser)
    loop(job, Batches(job.config, data, avatar), optimiser, state, path, mark)
    checkpoint.write(job.output.avatar, build.content(avatar, build.settings_of(job.config), data.head))
    lines = ["step\tseconds\tloss\tprobe_psnr", *("\t".join(f"{value:.6g}" for value in row) for row in state.curve)]
    job.output.curve.write_text("\n".join(lines) + "\n", encoding="utf-8")
    job.write_json(
        job.output.report,
        {
            "steps": state.step,
            "train_seconds": round(state.seconds, 2),
            "skipped_steps": state.skipped,
            "preflight_overlap": round(found, 3),
            "probe_psnr": state.curve[-1][-1],
            "probe_frames": data.probe,
            "training_frames": len(data.train),
            "evaluations_per_step": state.evaluations // max(state.step, 1),
            "precision": str(best_precision(job.device)).split(".")[1],
            "parameters": sum(parameter.numel() for parameter in avatar.parameters()),
            "peak_memory_mb": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024),
        },
    )


if __name__ == "__main__":
    step.main(run, TrainConfig)
