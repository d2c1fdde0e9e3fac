"""train: fit an avatar to the training frames. One visible loop; what was interrupted continues, on one thread to the bit."""

from __future__ import annotations

import resource
import time
from importlib import import_module
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from avatar import budget, build, checkpoint, coverage, learning
from avatar.checkpoint import BAD_WINDOW, State
from avatar.config import TrainConfig, modules_of
from avatar.dataset import Scene
from avatar.learning import Data, Learner
from fitting.files import load_head
from workflow import step

CHECKPOINT_S = 60.0
PROBE_FRAMES = 3  # training frames that are held out to watch progress
PROBES = 10  # times the curve is measured
BAD_SHARE = 0.01  # of the last BAD_WINDOW steps


class TrainingFailed(step.StepError):
    """The data or the settings do not let this avatar be trained; another try would end the same way."""


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


def verdict(loss: Tensor, gradients: list[Tensor], evaluations: int) -> str:
    """What is wrong with a step after its backward pass, or an empty string. evaluations: 0 when nothing met the head.

    Dead: most parameters get no gradient at all, which is how a network whose units have all died by too large steps looks
    (seen at a learning rate of 3e-3: everything turns white and stays so).
    """
    largest = torch.stack(torch._foreach_norm(gradients, float("inf"))) if gradients else loss.new_zeros(1)
    if not (torch.isfinite(loss) and torch.isfinite(largest).all()):
        return "a loss or gradient that is not finite"
    return "no gradient at all: the network is dead" if evaluations and (largest == 0).float().mean() > 0.5 else ""


def optimise(learner: Learner, state: State) -> float:
    """One step of training. Returns the loss."""
    learner.rates(state.step)
    learner.optimiser.zero_grad(set_to_none=True)
    loss = learner.loss(state.step)
    loss.value.backward()
    wrong = verdict(loss.value.detach(), learner.gradients(), loss.evaluations)
    if not wrong and loss.evaluations:  # where nothing meets the head there is nothing to learn, and momentum does not go on
        learner.optimiser.step()
    state.step, state.skipped, state.evaluations = (
        state.step + 1,
        state.skipped + bool(wrong),
        state.evaluations + loss.evaluations,
    )
    state.recent.append(bool(wrong))
    if sum(state.recent) > BAD_SHARE * BAD_WINDOW:
        raise TrainingFailed(
            f"training diverges at step {state.step}: {sum(state.recent)} of the last {len(state.recent)} steps had {wrong}, "
            f"the last on frames {loss.frames}; lower train.learning_rate"
        )
    return float(loss.value.detach())


def loop(job: step.Job, learner: Learner, data: Data, state: State, path: Path, mark: str, until: int) -> None:
    """Train to step `until` of the config's, with a checkpoint every minute and when interrupted."""
    config = job.config
    started, before = time.perf_counter(), state.seconds
    saved, every = started, max(1, config.steps // (PROBES if config.budget is None else budget.PROBES))
    with checkpoint.deferred_interrupts() as interrupted:
        for _ in job.progress(range(state.step, until), "training"):
            if budget.ends(job, state):
                break
            state.losses.append(optimise(learner, state))
            state.seconds = before + time.perf_counter() - started
            if state.step % every == 0 or state.step == config.steps:
                quality = learning.probe_psnr(learner, data)
                state.curve.append([state.step, state.seconds, float(np.mean(state.losses)), quality])
                job.log.info("step %d: loss %.4f, probe %.2f dB, %.0f s", *(state.curve[-1][i] for i in (0, 2, 3, 1)))
                state.losses = []
            if interrupted or time.perf_counter() - saved > CHECKPOINT_S:
                checkpoint.save(path, mark, state, learner.avatar, learner.optimiser)
                saved = time.perf_counter()
            if interrupted:
                raise KeyboardInterrupt
    checkpoint.save(path, mark, state, learner.avatar, learner.optimiser)


def run(job: step.Job) -> None:
    """Inputs head frames alpha track split; outputs avatar curve report."""
    data = load(job)
    found = preflight(job, data)
    # By name: code that trains one kind of avatar is no part of the digest of the others.
    learner = import_module(modules_of(job.config.representation, training=True)[-1]).learner(job, data)
    path, mark = job.final.avatar.parent / "checkpoints" / "last.pt", checkpoint.fingerprint(job)
    state = checkpoint.resume(job, path, mark, learner.avatar, learner.optimiser)
    plans = [(job, job.config.steps)]
    if job.config.budget is not None:
        plans = budget.schedules(job, learner, data, state, optimise)
    for planned, until in plans:
        loop(planned, learner, data, state, path, mark, until)
    checkpoint.write(job.output.avatar, build.content(learner.avatar, build.settings_of(job.config), data.head))
    lines = ["step\tseconds\tloss\tprobe_psnr", *("\t".join(f"{value:.6g}" for value in row) for row in state.curve)]
    job.output.curve.write_text("\n".join(lines) + "\n", encoding="utf-8")
    job.write_json(
        job.output.report,
        {
            "steps": state.step,
            **({"budget": {"decisions": state.decisions}} if state.decisions else {}),
            "train_seconds": round(state.seconds, 2),
            "skipped_steps": state.skipped,
            "preflight_overlap": round(found, 3),
            "probe_psnr": state.curve[-1][-1],
            "probe_frames": data.probe,
            "training_frames": len(data.train),
            "evaluations_per_step": state.evaluations // max(state.step, 1),
            "precision": str(learner.precision()).split(".")[1],
            "parameters": sum(parameter.numel() for parameter in learner.avatar.parameters()),
            "peak_memory_mb": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024),
        },
    )


if __name__ == "__main__":
    step.main(run, TrainConfig)
