# What the rules of uses, drivers, comparisons and exports share: their inputs and configs. Names of common.smk are known here.
from snakemake.exceptions import WorkflowError

from avatar.uses.config import DriveStepConfig


def driver_video(subject):
    """The video behind a subject `driver.NAME`."""
    return Path(SETTINGS.drivers[subject.removeprefix(DRIVER)].video).expanduser()


def comparison_of(wildcards):
    """What the config says of a comparison."""
    return SETTINGS.comparisons[wildcards.comparison]


def comparison_video(wildcards):
    """The comparison video; it counts by content, not by time."""
    path = Path(comparison_of(wildcards).video).expanduser()
    if not path.is_file():
        raise WorkflowError(f"{CONFIG}: comparisons.{wildcards.comparison}.video: there is no file {path}")
    return ancient(str(path))


def comparison_config(*keys, **more):
    """Panels of a comparison, further keys of it, and what else a step wants."""
    chosen = ("panels", "driving", *keys)
    return lambda wildcards: json.dumps({key: getattr(comparison_of(wildcards), key) for key in chosen} | more)


def published_render_config(wildcards):
    """Samples as the variant says, frames as the comparison says."""
    samples = VARIANTS[wildcards.variant]["render"].sample_factor
    return json.dumps({"sample_factor": samples, "stride": comparison_of(wildcards).stride})


def published_pictures(wildcards):
    """What of a method stands in files: an avatar's or a predictor's pictures; a panel is in the video."""
    if wildcards.method.startswith("panel."):
        return {}
    folder = f"results/published/{wildcards.comparison}/{wildcards.method}"
    found = {"png": f"{folder}/png", "opacity": f"{folder}/opacity.npy", "report": f"{folder}/render.json"}
    if wildcards.method in VARIANTS:
        found["train"] = f"results/{PUBLISHED}{wildcards.comparison}/{wildcards.method}/train.json"
    return found


def published_score_config(wildcards):
    """Which method is scored, and how its pictures came about."""
    name = wildcards.method.removeprefix("panel.")
    kind = "published" if name != wildcards.method else "avatar" if name in VARIANTS else "predictor"
    return comparison_config("stride", method=name, kind=kind)(wildcards)


def of_methods(name):
    """A file of every method of a comparison: avatars, predictors, published panels."""

    def paths(wildcards):
        panels = [
            f"panel.{panel}" for panel in comparison_of(wildcards).panels if panel != comparison_of(wildcards).driving
        ]
        return [f"results/published/{wildcards.comparison}/{method}/{name}" for method in [*ALL_VARIANTS, *panels]]

    return paths


def compared(wildcards):
    """Tables and pictures of all comparisons."""
    if not SETTINGS.comparisons:
        example = "comparisons: {NAME: {video: FILE, panels: [driving, METHOD]}}"
        raise WorkflowError(f"{CONFIG}: comparisons names no comparison video to compare with; for example {example}")
    return expand("results/published/{name}/{file}", name=SETTINGS.comparisons, file=["table.md", "strip.png"])


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


def of_uses(subject, pattern, **more):
    """What a use of avatars wants of a subject: the pattern's file of every variant; of a rejected one nothing."""
    return expand(pattern, subject=subject, variant=VARIANTS, **more) if accepted(subject) else []


def uses_files(kind):
    """Files of one kind (`mp4`, `png` or `json`) of all that an avatar is used for: config's drivers and animations as well."""

    def paths(wildcards):
        names = {"mp4": ["orbit", "extrapolate", "flicker"], "png": ["orbit", "extrapolate", "sheet"]}
        uses = names.get(kind, ["orbit", "extrapolate", "sheet", "flicker"])
        files = [f"{use}/{use}.{kind}" for use in uses]
        if kind != "png":
            files += [f"animate/{name}/animate.{kind}" for name in SETTINGS.animate]
        own = [name for name, driver in SETTINGS.drivers.items() if driver.subject == wildcards.subject]
        last = "strip.png" if kind == "png" else f"drive.{kind}"
        files += [f"drive/{name}/{last}" for name in own if may_move(name, DRIVER + name, "its video")]
        return [f"results/{wildcards.subject}/{wildcards.variant}/{file}" for file in files]

    return paths


def use_config(use):
    """Config of a use; how finely its rays are sampled is the variant's own, where the config does not say."""

    def config(wildcards):
        keys = SETTINGS.animate[wildcards.name] if use == "animate" else getattr(SETTINGS, use)
        factor = keys.sample_factor or VARIANTS[wildcards.variant]["render"].sample_factor
        return keys.model_copy(update={"sample_factor": factor}).model_dump_json()

    return config


def drive_config(wildcards):
    """As `use_config`, with what the config says of the driver."""
    keys = json.loads(use_config("drive")(wildcards)) | SETTINGS.drivers[wildcards.driver].model_dump()
    keys = {name: value for name, value in keys.items() if name not in ("video", "subject")}
    return DriveStepConfig(**keys, driver=wildcards.driver).model_dump_json()


@cache
def _left_out(name, reason):
    """Have the last lines of a run say why a driver moves nothing; once, however often the plan is made."""
    atexit.register(lambda: print(f"driver {name}: left out, {reason}", file=sys.stderr))


def may_move(name, who, what):
    """Whether probe accepts one of the two videos of a driver; where not, the last lines of the run say why."""
    if accepted(who):
        return True
    probe = json.loads(Path(f"results/{who}/probe/probe.json").read_text(encoding="utf-8"))
    _left_out(name, f"{what} is rejected: {probe['reason']}")
    return False


def drive_of(name):
    """What `drive` wants of a driver: a video an avatar, or, where probe rejects one of the two videos, the reason alone."""
    if name is None:
        raise WorkflowError(
            f"{CONFIG}: drivers is empty; name a driving video: drivers: {{NAME: {{video: FILE, subject: SUBJECT}}}}"
        )
    subject = SETTINGS.drivers[name].subject
    for who, what in ((DRIVER + name, "its video"), (subject, f"the video of {subject}")):
        if not may_move(name, who, what):
            return f"results/{who}/probe/probe.json"
    pattern = "results/{subject}/{variant}/drive/{driver}/drive.json"
    return expand(pattern, subject=subject, variant=VARIANTS, driver=name)


def parameter_file(wildcards):
    """The user's own file that drives an avatar. Its content counts (see `content_of_parameter_file`), its time does not."""
    return ancient(str(Path(SETTINGS.animate[wildcards.name].file).expanduser()))


def content_of_parameter_file(wildcards):
    """Hash of the file; a file that is not there is Snakemake's to report."""
    path = Path(SETTINGS.animate[wildcards.name].file).expanduser()
    return sha256_of(str(path)) if path.is_file() else "missing"


def animations_of(subject):
    """What `animate` wants of a subject."""
    if not SETTINGS.animate:
        how = "for example animate: {wave: {file: wave.csv}}; README, 'Uses', says what the file holds"
        raise WorkflowError(f"animate: name a parameter file in {CONFIG}, {how}")
    return of_uses(subject, "results/{subject}/{variant}/animate/{name}/animate.json", name=SETTINGS.animate)


def half_data_of(subject):
    """Scores of every variant, trained on all and on half of the frames."""
    pattern = "results/{subject}/{variant}/metrics/{file}"
    files = ["metrics.json", "per_frame.csv"]
    return expand(pattern, subject=subject, variant=TRAINED, file=files) if accepted(subject) else []


def half_data_config(wildcards):
    """As `table_config`: each variant with its half beside it."""
    return json.dumps({"subjects": SUBJECTS, "variants": [name + end for name in VARIANTS for end in ("", HALF)]})


def tabulate_half(wildcards, input, output, threads):
    """As `step`, with the scores by the names under which the table's step knows them."""
    scores = [path for path in input if path not in input.probes]
    files = {"probes": input.probes}
    for name, ending in {"metrics": ".json", "per_frames": ".csv"}.items():
        files[name] = [path for path in scores if path.endswith(ending)]
    return step("avatar.report.tabulate", subject="half_data")(wildcards, files, output, threads)
