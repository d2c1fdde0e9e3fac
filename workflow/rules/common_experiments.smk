# What the rules of simulated clips, the tracking benchmark, the ablation and the speed table share. Names of common.smk are known here.
from types import SimpleNamespace

from avatar.ablation import settings as ablation_settings
from avatar.speed_error import settings as speed_settings
from fitting.config import BenchmarkConfig, SimulateConfig


def simulate_config(wildcards):
    """What the config says of simulated videos, and over it what the video's name says: KIND_SEED[_FRAMES][_HAIR]."""
    named = {"kind": wildcards.kind, "seed": int(wildcards.seed)}
    for word in wildcards.options.split("_")[1:]:
        named |= {"frames": int(word)} if word.isdecimal() else {"hair": word}
    return SimulateConfig(**SETTINGS.simulate.model_dump() | named).model_dump_json()


def truth_of(wildcards):
    """The truth of a simulated clip, where the head that is fitted has the same vertices."""
    clip = wildcards.subject.removeprefix(benchmark_settings.PREFIX)
    known = wildcards.subject not in VIDEOS and SETTINGS.head.model == "anny"
    return {"truth": f"simulated/truth/{clip}.npz"} if known else {}


def benchmark_config(wildcards):
    """The setting that the file's name says, on the shipped config: the user's own fit keys do not count here."""
    fit = benchmark_settings.SETTINGS[wildcards.setting].fit
    frames = benchmark_settings.frames_of(wildcards.subject, wildcards.setting)
    return BenchmarkConfig(fit=fit, frames=frames, simulated=wildcards.subject not in VIDEOS).model_dump_json()


def benchmark_rows(wildcards):
    """Rows of the benchmark: simulated clips, and the first of the user's own that have a face."""
    own = list(filter(accepted, sorted(SUBJECTS)[: max(benchmark_settings.REAL_CLIPS.values())]))
    pattern = "results/tracking_benchmark/rows/{}/{}.json"
    return [pattern.format(*row) for row in benchmark_settings.planned(own)]


def of_simulated(content):
    """The paths by name for a simulated subject, with its clip's name filled in; nothing for a real one."""

    def paths(wildcards):
        clip = wildcards.subject.removeprefix(benchmark_settings.PREFIX)
        return {name: path.format(clip=clip) for name, path in content.items()} if clip != wildcards.subject else {}

    return paths


def ablation_data_config(wildcards):
    """Size and frames, the config's trim keys, and what a simulated clip was made from."""
    clip = re.fullmatch(rf"{re.escape(benchmark_settings.PREFIX)}([a-z]+)_(\d+)(\w*)", wildcards.subject)
    made = clip and simulate_config(SimpleNamespace(kind=clip[1], seed=clip[2], options=clip[3]))
    return ablation_settings.data_config(SETTINGS.trim, made).model_dump_json()


def ablation_inputs(wildcards):
    """What a cell trains on: tracked or true parameters, all or half of the frames; doubled codes where their truth is known."""
    folder, group = f"results/ablation/data/{wildcards.subject}", ablation_settings.CELLS[wildcards.cell].group
    own = {"head": f"{folder}/true_head.npz", "track": f"{folder}/true_track.npz"}
    tracked = {"head": HEAD, "track": f"{folder}/track.npz"}
    split = {"split": f"{folder}/{ {'half': 'half', 'overfit': 'four'}.get(group, 'split') }.json"}
    doubled = {} if group == "overfit" else of_simulated({"doubled": f"{folder}/doubled.npz"})(wildcards)
    return (own if group in ("true", "overfit") else tracked) | split | doubled


def ablation_config(wildcards):
    """The cell that the file's name says: the user's own train keys do not count here."""
    return ablation_settings.config_of(wildcards.cell, int(wildcards.seed)).model_dump_json()


def ablation_code(wildcards):
    """As `model_code_of`, for the cell's representation."""
    representation = ablation_settings.CELLS[wildcards.cell].representation
    return digest_of("avatar.ablation.cell", modules_of(representation, training=True))


def ablation_rows(wildcards):
    """Rows of the simulated subject and of the user's own that have a face."""
    pattern = "results/ablation/rows/{}/{}/{}.json"
    return [pattern.format(*row) for row in ablation_settings.planned(list(filter(accepted, SUBJECTS)))]


if SETTINGS.speed_error.subject:
    try:
        checks.check_names([SETTINGS.speed_error.subject], SUBJECTS, "speed_error.subject", CONFIG)
    except checks.SettingsError as mistake:
        raise SystemExit(str(mistake)) from None
PRESETS = {
    path.stem: TrainConfig(
        **checks.read_preset(path.stem, path.parent, {"train": TrainConfig, "render": RenderConfig}).get("train") or {}
    )
    for path in sorted((Path(workflow.basedir) / "config" / "presets").glob("*.yaml"))
}
SPEED_TRAININGS, SPEED_CELLS = speed_settings.trainings(PRESETS), speed_settings.cells(PRESETS)
SPEED_COSTS = speed_settings.costs(PRESETS)
TIMED_INPUTS = {
    "head": HEAD,
    "frames": "results/{subject}/frames/frames.npy",
    "alpha": "results/{subject}/trim/alpha.npy",
    "track": "results/{subject}/fit/track.npz",
    "split": "results/{subject}/split.json",
}
ALL_CORES = workflow.cores or 8


def speed_assets(wildcards):
    """Networks that a training compares pictures with."""
    layers = SPEED_TRAININGS[wildcards.training].config.representation == "layers"
    return {"vgg": asset("lpips_vgg16.ckpt")} if layers else {}


def speed_training_of(training, name):
    """A file of one training of `speed_error`."""
    return f"results/speed_error/{{subject}}/trainings/{training}/{name}"


def speed_code(command, training_of):
    """As `model_code_of`, for the representation of the training that a cell needs. training_of: cell's name -> training's."""

    def code(wildcards):
        cell = next(value for name, value in wildcards.items() if name != "subject")
        modules = modules_of(SPEED_TRAININGS[training_of(cell)].config.representation, training=True)
        return digest_of(command, modules if "rendering" not in command else modules[:-1])

    return code


def speed_error_files(wildcards):
    """Tables and plot of the config's subject, or of the first one that has a face."""
    chosen = SETTINGS.speed_error.subject or next(filter(accepted, SUBJECTS), None)
    if chosen is None:
        raise ValueError("speed_error: none of the videos has a face")
    names = ("table.csv", "table.md", "table.tex", "plot.svg", "report.json")
    return [f"results/speed_error/{chosen}/{name}" for name in names]
