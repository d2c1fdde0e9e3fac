# The only place with Python: config checked, videos found, and the helpers that the rules share.
# Parsed again by every cluster job: nothing here imports torch, and nothing prints.
import atexit
import hashlib
import json
import shlex
import sys
from functools import cache
from pathlib import Path
from types import SimpleNamespace

from snakemake.exceptions import WorkflowError

from avatar import ablation_settings
from avatar.config import RenderConfig, Settings, TrainConfig
from fitting import benchmark_settings
from fitting.assets import ASSETS
from fitting.config import BenchmarkConfig, SimulateConfig
from workflow import settings as checks
from workflow.digest import code_digest
from workflow.settings import PREDICTORS
from workflow.summary import summary

CONFIG = "config/config.yaml or --config"
try:
    SETTINGS = checks.validated(Settings, config, CONFIG)
    VARIANTS = checks.resolve_variants(
        SETTINGS.variants,
        Path(workflow.basedir) / "config" / "presets",
        {"train": TrainConfig, "render": RenderConfig},
        CONFIG,
    )
    checks.check_names(SETTINGS.assets, ASSETS, "assets", CONFIG)
    # The user's own files of the head model, by the name under which the step knows them.
    HEAD_KEYS = {"model": "path", "uv": "uv", "masks": "masks", "landmark_embedding": "landmark_embedding"}
    HEAD_FILES = {name: getattr(SETTINGS.head, key) for name, key in HEAD_KEYS.items() if getattr(SETTINGS.head, key)}
    HEAD_FILES = {name: str(Path(path).expanduser()) for name, path in HEAD_FILES.items()}
    for name, path in HEAD_FILES.items():
        if not Path(path).is_file():
            where = "; FLAME is at https://flame.is.tue.mpg.de (registration needed)"
            raise checks.SettingsError(f"{CONFIG}: head.{HEAD_KEYS[name]}: there is no file {path}{where}")
    VIDEOS = checks.discover(Path(SETTINGS.videos))
except checks.SettingsError as mistake:
    raise SystemExit(str(mistake)) from None

HEAD = f"resources/heads/{SETTINGS.head.model}.npz"
HEAD_SOURCE = {"anny": "fitting.anny_head", "flame": "fitting.flame"}[SETTINGS.head.model]
SUBJECTS = list(VIDEOS)
ALL_VARIANTS = [*VARIANTS, *PREDICTORS]
# Once a run: an edit while it runs counts in the next one.
digest_of = cache(code_digest)
PYTHON = shlex.quote(sys.executable)


# A simulated clip is a subject too, but none of `all`.
wildcard_constraints:
    subject="|".join([*map(re.escape, SUBJECTS), re.escape(benchmark_settings.PREFIX) + r"[a-z]+_\d+[a-z0-9_]*"]),
    variant="|".join(map(re.escape, ALL_VARIANTS)),
    predictor="|".join(PREDICTORS),
    asset="|".join(map(re.escape, ASSETS)),


def named(paths):
    """NAME=PATH for the command line; a name that holds several paths is repeated."""
    pairs = [(name, [found] if isinstance(found, str) else found) for name, found in paths.items()]
    return " ".join(shlex.quote(f"{name}={path}") for name, found in pairs for path in found)


def step(name, subject=None, device=False, one_thread=False):
    """How a rule calls a step, but for its config and code, which are parameters of their own.

    A function of input and output, so that none of this counts as a parameter: where the work runs, and on how many threads,
    changes no result.
    """

    def call(wildcards, input, output, threads):
        who = subject or wildcards.get("subject") or wildcards.asset
        where = f" --device {shlex.quote(SETTINGS.device)}" if device else ""
        files = f"--input {named(input)} --output {named(output)}"
        count = 1 if one_thread else threads
        return f"{PYTHON} -m {name} --subject {shlex.quote(who)} --threads {count}{where} {files}"

    return call


def config_of(step):
    """Resolved config of a step, defaults included, as one JSON parameter."""
    text = getattr(SETTINGS, step).model_dump_json()
    return lambda wildcards: text


def variant_config(step):
    """As `config_of`, for the steps that a preset configures."""
    return lambda wildcards: VARIANTS[wildcards.variant][step].model_dump_json()


def predictor_config(wildcards):
    """A predictor takes the frames that the first variant renders."""
    max_frames = next(iter(VARIANTS.values()))["render"].max_frames
    return json.dumps({"predictor": wildcards.predictor, "max_frames": max_frames})


def table_config(wildcards):
    """Rows and columns that a table must have, whatever became of them."""
    return json.dumps({"subjects": SUBJECTS, "variants": ALL_VARIANTS})


def code_of(command, extra=()):
    """Digest of the code that a step imports, with modules that it imports by name."""
    return lambda wildcards: digest_of(command, extra)


def model_code_of(command):
    """As `code_of`, with the module of the variant's representation, which is imported by name."""

    def code(wildcards):
        representation = VARIANTS[wildcards.variant]["train"].representation
        return digest_of(command, (f"avatar.features.{representation}",))

    return code


def asset(name):
    """Path of a fetched file. Its content is fixed by its sha256 (see `sha_of`), so its time says nothing."""
    return ancient(f"resources/assets/{name}")


def sha_of(name):
    """What an asset must hash to: another model is another parameter."""
    return ASSETS[name].sha256


def head_files(wildcards):
    """The user's own files of the head model. Their content counts (see `content_of_head_files`), their time does not."""
    return {name: ancient(path) for name, path in HEAD_FILES.items()}


@cache
def sha256_of(path):
    """Hash of a whole file, once a run."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def content_of_head_files(wildcards):
    """Hashes of the user's own files of the head model: replacing one by another of the same name bakes again."""
    return {name: sha256_of(path) for name, path in HEAD_FILES.items()}


def video_of(wildcards):
    """The subject's video. A user's own counts by content (see `content_of_video`), not by time."""
    if wildcards.subject in VIDEOS:
        return ancient(str(VIDEOS[wildcards.subject]))
    return f"simulated/videos/{wildcards.subject.removeprefix(benchmark_settings.PREFIX)}.mp4"


def content_of_video(wildcards):
    """Fingerprint of the video: touching or copying it changes nothing, another video does."""
    return checks.fingerprint(VIDEOS[wildcards.subject]) if wildcards.subject in VIDEOS else "simulated"


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
    return digest_of("avatar.ablation", (f"avatar.features.{representation}",))


def ablation_rows(wildcards):
    """Rows of the simulated subject and of the user's own that have a face."""
    pattern = "results/ablation/rows/{}/{}/{}.json"
    return [pattern.format(*row) for row in ablation_settings.planned(list(filter(accepted, SUBJECTS)))]


def accepted(subject):
    """Whether probe found one face in most frames; asking makes the plan wait for probe."""
    path = checkpoints.probe.get(subject=subject).output.probe
    return json.loads(Path(path).read_text(encoding="utf-8"))["accepted"]


def page_of(subject):
    """What is wanted of a subject: its page, and of a rejected one the reason alone.

    One input function per subject: one that fails in probe holds back no other.
    """
    return lambda wildcards: f"results/{subject}/page" if accepted(subject) else f"results/{subject}/probe/probe.json"


def exportable_head(wildcards):
    """The head model, where other programs know its codes."""
    if SETTINGS.head.model == "anny":
        raise WorkflowError(
            "export: the track of the default head (head.model: anny) cannot be written as FLAME codes; "
            "set head.model: flame and head.path, your own FLAME file, and run snakemake again"
        )
    return HEAD


def export_of(subject):
    """What `export_all` wants of a subject; a rejected one has nothing to export."""
    exportable_head(None)
    return f"results/{subject}/export/export.json" if accepted(subject) else []


def training_of(wildcards):
    """Report of the training behind a render; a predictor has none."""
    pattern = "results/{subject}/{variant}/train.json"
    return expand(pattern, **wildcards) if wildcards.variant in VARIANTS else []


def of_accepted(pattern):
    """The pattern's file of every accepted subject and every variant."""

    def paths(wildcards):
        return expand(pattern, subject=filter(accepted, SUBJECTS), variant=ALL_VARIANTS)

    return paths


def of_subject(pattern, variants):
    """The pattern's file of every variant of one subject."""
    return expand(pattern, variant=variants, allow_missing=True)


def tabulate_existing(wildcards, threads):
    """As `step`, for a table of what exists now."""
    probes = [path for path in expand("results/{subject}/probe/probe.json", subject=SUBJECTS) if Path(path).exists()]
    pattern = "results/{subject}/{variant}/metrics/metrics.json"
    metrics = [path for path in expand(pattern, subject=SUBJECTS, variant=ALL_VARIANTS) if Path(path).exists()]
    input = {"probes": probes, "metrics": metrics}
    output = {"csv": "results/tables/available.csv", "markdown": "results/tables/available.md"}
    return step("avatar.tabulate", subject="all")({}, input, output, threads)


def summarise_at_exit():
    """Have the last lines of a run say what came of every subject."""
    atexit.register(lambda: print("", *summary(SUBJECTS, VARIANTS), sep="\n", file=sys.stderr))
