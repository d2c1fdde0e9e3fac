# The only place with Python, with common_uses.smk and common_experiments.smk: config checked, videos found, and the helpers that
# the rules share.
# Parsed again by every cluster job: nothing here imports torch, and nothing prints.
import atexit
import hashlib
import json
import shlex
import subprocess
import sys
from functools import cache
from pathlib import Path

from avatar.config import RenderConfig, TrainConfig, modules_of
from avatar.settings import Settings
from fitting import benchmark_settings
from fitting.assets import ASSETS
from workflow import settings as checks
from workflow.digest import code_digest
from workflow.settings import PREDICTORS
from workflow.summary import failed_logs, summary

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
    checks.check_drivers(SETTINGS.drivers, VIDEOS, CONFIG)
except checks.SettingsError as mistake:
    raise SystemExit(str(mistake)) from None

HEAD = f"resources/heads/{SETTINGS.head.model}.npz"
HEAD_SOURCE = {"anny": "fitting.anny_head", "flame": "fitting.flame"}[SETTINGS.head.model]
SUBJECTS = list(VIDEOS)
ALL_VARIANTS = [*VARIANTS, *PREDICTORS]
DRIVER = "driver."  # before a driver's name: its video as a subject
PUBLISHED = "published."  # before a comparison's name: its driving panel as a subject
# `snakemake half_data` trains every variant once more, on the first half of its frames. A variant's own name has no dot.
HALF = ".half"
TRAINED = VARIANTS | {name + HALF: keys for name, keys in VARIANTS.items()}
# Once a run: an edit while it runs counts in the next one.
digest_of = cache(code_digest)
PYTHON = shlex.quote(sys.executable)


# A simulated clip, a driving video and a comparison's driving panel are subjects too, but none of `all`.
wildcard_constraints:
    subject="|".join(
        [
            *map(re.escape, [*SUBJECTS, *(PUBLISHED + name for name in SETTINGS.comparisons)]),
            *(re.escape(DRIVER + name) for name in SETTINGS.drivers),
            re.escape(benchmark_settings.PREFIX) + r"[a-z]+_\d+[a-z0-9_]*",
        ]
    ),
    comparison="|".join(map(re.escape, SETTINGS.comparisons)) or "(?!)",
    variant="|".join(map(re.escape, [*TRAINED, *PREDICTORS])),
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
        who = subject or wildcards.get("subject") or wildcards.get("comparison") or wildcards.asset
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
    return lambda wildcards: TRAINED[wildcards.variant][step].model_dump_json()


def predictor_config(wildcards):
    """A predictor takes the frames that the first variant renders; of a comparison's driving panel all."""
    whole = wildcards.subject.startswith(PUBLISHED)
    max_frames = None if whole else next(iter(VARIANTS.values()))["render"].max_frames
    return json.dumps({"predictor": wildcards.predictor, "max_frames": max_frames})


def table_config(wildcards):
    """Rows and columns that a table must have, whatever became of them."""
    return json.dumps({"subjects": SUBJECTS, "variants": ALL_VARIANTS})


def code_of(command, extra=()):
    """Digest of the code that a step imports, with modules that it imports by name."""
    return lambda wildcards: digest_of(command, extra)


def model_code_of(command):
    """As `code_of`, with the modules of the variant's representation, which are imported by name."""

    def code(wildcards):
        representation = TRAINED[wildcards.variant]["train"].representation
        return digest_of(command, modules_of(representation, training=command == "avatar.train"))

    return code


def perceptual_of(wildcards):
    """Weights of the perceptual loss, for a representation that learns from images."""
    learning = modules_of(TRAINED[wildcards.variant]["train"].representation, training=True)[-1]
    return asset("lpips_vgg16.ckpt") if learning.endswith(".images") else []


def perceptual_sha_of(wildcards):
    """As `perceptual_of`, the content."""
    return sha_of("lpips_vgg16.ckpt") if perceptual_of(wildcards) else ""


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
    if wildcards.subject.startswith(DRIVER):
        return ancient(str(driver_video(wildcards.subject)))
    if wildcards.subject.startswith(PUBLISHED):
        return f"results/published/{wildcards.subject.removeprefix(PUBLISHED)}/driving.mp4"
    return f"simulated/videos/{wildcards.subject.removeprefix(benchmark_settings.PREFIX)}.mp4"


def content_of_video(wildcards):
    """Fingerprint of the video: touching or copying it changes nothing, another video does."""
    if wildcards.subject.startswith(DRIVER):
        return checks.fingerprint(driver_video(wildcards.subject))
    made = "published" if wildcards.subject.startswith(PUBLISHED) else "simulated"
    return checks.fingerprint(VIDEOS[wildcards.subject]) if wildcards.subject in VIDEOS else made


def split_config(wildcards):
    """The config's split, but of a comparison's driving panel exactly its test frames."""
    name = wildcards.subject.removeprefix(PUBLISHED)
    if name == wildcards.subject:
        return SETTINGS.split.model_dump_json()
    return SETTINGS.split.model_copy(update={"test_frames": SETTINGS.comparisons[name].test_frames}).model_dump_json()


def accepted(subject):
    """Whether probe found one face in most frames; asking makes the plan wait for probe."""
    path = checkpoints.probe.get(subject=subject).output.probe
    return json.loads(Path(path).read_text(encoding="utf-8"))["accepted"]


def page_of(subject):
    """What is wanted of a subject: its page, and of a rejected one the reason alone.

    One input function per subject: one that fails in probe holds back no other.
    """
    return lambda wildcards: f"results/{subject}/page" if accepted(subject) else f"results/{subject}/probe/probe.json"


def training_of(wildcards):
    """Report of the training behind a render; a predictor has none."""
    pattern = "results/{subject}/{variant}/train.json"
    return expand(pattern, **wildcards) if wildcards.variant in TRAINED else []


def split_of(wildcards):
    """The frames that train and test: of a variant on half of the data those of the first half."""
    half = "_half" if wildcards.variant.endswith(HALF) else ""
    return f"results/{wildcards.subject}/split{half}.json"


def of_accepted(pattern):
    """The pattern's file of every accepted subject and every variant."""

    def paths(wildcards):
        return expand(pattern, subject=filter(accepted, SUBJECTS), variant=ALL_VARIANTS)

    return paths


def of_subject(pattern, variants):
    """The pattern's file of every variant of one subject."""
    return expand(pattern, variant=variants, allow_missing=True)


def available(wildcards=None):
    """Command for the tables and the index page of what exists now; where scores are missing, the log of what did not finish."""
    existing = lambda paths: [path for path in paths if Path(path).exists()]  # noqa: E731
    of_all = {"subject": SUBJECTS, "variant": ALL_VARIANTS}
    found = {
        "probes": existing(expand("results/{subject}/probe/probe.json", subject=SUBJECTS)),
        "per_frames": existing(expand("results/{subject}/{variant}/metrics/per_frame.csv", **of_all)),
        "metrics": existing(expand("results/{subject}/{variant}/metrics/metrics.json", **of_all)),
        "logs": existing(dict.fromkeys(map(str, failed_logs(SUBJECTS, ALL_VARIANTS, PREDICTORS)))),
    }
    names = {"csv": "available.csv", "per_frame": "available_per_frame.csv"}
    for prefix, name in {"": "available", "regions_": "available_regions"}.items():
        names |= {f"{prefix}markdown": f"{name}.md", f"{prefix}latex": f"{name}.tex"}
    tables = {name: f"results/tables/{file}" for name, file in names.items()}
    pages = {
        "table": tables["csv"],
        "pages": existing(expand("results/{subject}/page", subject=SUBJECTS)),
        "plots": existing(["results/plots/speed.svg"]),
    }
    tabulate = step("avatar.report.tabulate", subject="all")({}, found, tables, 1)
    tabulate = f"{tabulate} --config {shlex.quote(table_config(None))} --code {digest_of('avatar.report.tabulate')}"
    index = step("avatar.report.index_page", subject="all")({}, pages, {"page": "results/available"}, 1)
    index = f"{index} --code {digest_of('avatar.report.index_page')}"
    return f"{{ {tabulate} && {index} ; }}"


def make_available():
    """After a run in which something failed: tables and index page, each failure with its reason, as `snakemake available`."""
    if any(Path(f"results/{subject}/probe/probe.json").exists() for subject in SUBJECTS):
        made = subprocess.run(f"{available()} > logs/available.log 2>&1", shell=True, check=False).returncode == 0
        where = (
            "results/tables/available.md, results/available/index.html" if made else "failed, see logs/available.log"
        )
        atexit.register(lambda: print(f"what exists: {where}", file=sys.stderr))


def summarise_at_exit():
    """Have the last lines of a run say what came of every subject."""
    atexit.register(lambda: print("", *summary(SUBJECTS, VARIANTS), sep="\n", file=sys.stderr))
