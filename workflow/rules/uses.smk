# What people do with an avatar, each when asked for by name, for every subject that has a face and every configured variant:
# `snakemake orbit`, `extrapolate`, `sheet`, `animate`, `half_data`; one file alone by its path. Nothing in `all` asks for them.
# `snakemake uses` makes all but the last, with `drive` and `flicker`, and one page of it for each avatar.
# One input function per subject, as for pages: one that fails in probe holds back no other.


rule orbit_around:
    input:
        head=HEAD,
        avatar="results/{subject}/{variant}/avatar.pt",
        frames="results/{subject}/frames/frames.npy",
        index="results/{subject}/frames/frames.json",
        track="results/{subject}/fit/track.npz",
        split="results/{subject}/split.json",
    output:
        video="results/{subject}/{variant}/orbit/orbit.mp4",
        sheet="results/{subject}/{variant}/orbit/orbit.png",
        report="results/{subject}/{variant}/orbit/orbit.json",
    log:
        "logs/{subject}/{variant}/orbit.log",
    benchmark:
        "benchmarks/{subject}/{variant}/orbit.tsv"
    wildcard_constraints:
        variant="|".join(map(re.escape, VARIANTS)),
    threads: 8
    resources:
        gpu=1,
    params:
        config=use_config("orbit"),
        code=model_code_of("avatar.uses.orbit"),
        run=step("avatar.uses.orbit", device=True),
    shell:
        "{params.run} --config {params.config:q} --code {params.code} > {log:q} 2>&1"


rule orbit:
    input:
        [
            lambda wildcards, subject=subject: of_uses(subject, "results/{subject}/{variant}/orbit/orbit.json")
            for subject in SUBJECTS
        ],


rule extrapolate_codes:
    input:
        head=HEAD,
        avatar="results/{subject}/{variant}/avatar.pt",
        frames="results/{subject}/frames/frames.npy",
        index="results/{subject}/frames/frames.json",
        alpha="results/{subject}/trim/alpha.npy",
        track="results/{subject}/fit/track.npz",
        split="results/{subject}/split.json",
    output:
        video="results/{subject}/{variant}/extrapolate/extrapolate.mp4",
        sheet="results/{subject}/{variant}/extrapolate/extrapolate.png",
        report="results/{subject}/{variant}/extrapolate/extrapolate.json",
    log:
        "logs/{subject}/{variant}/extrapolate.log",
    benchmark:
        "benchmarks/{subject}/{variant}/extrapolate.tsv"
    wildcard_constraints:
        variant="|".join(map(re.escape, VARIANTS)),
    threads: 8
    resources:
        gpu=1,
    params:
        config=use_config("extrapolate"),
        code=model_code_of("avatar.uses.extrapolate"),
        run=step("avatar.uses.extrapolate", device=True),
    shell:
        "{params.run} --config {params.config:q} --code {params.code} > {log:q} 2>&1"


rule extrapolate:
    input:
        [
            lambda wildcards, subject=subject: of_uses(
                subject, "results/{subject}/{variant}/extrapolate/extrapolate.json"
            )
            for subject in SUBJECTS
        ],


rule sheet_of:
    input:
        head=HEAD,
        avatar="results/{subject}/{variant}/avatar.pt",
        frames="results/{subject}/frames/frames.npy",
        index="results/{subject}/frames/frames.json",
        alpha="results/{subject}/trim/alpha.npy",
        track="results/{subject}/fit/track.npz",
        split="results/{subject}/split.json",
    output:
        sheet="results/{subject}/{variant}/sheet/sheet.png",
        folder=directory("results/{subject}/{variant}/sheet/frames"),
        report="results/{subject}/{variant}/sheet/sheet.json",
    log:
        "logs/{subject}/{variant}/sheet.log",
    benchmark:
        "benchmarks/{subject}/{variant}/sheet.tsv"
    wildcard_constraints:
        variant="|".join(map(re.escape, VARIANTS)),
    threads: 8
    resources:
        gpu=1,
    params:
        config=use_config("sheet"),
        code=model_code_of("avatar.uses.sheet"),
        run=step("avatar.uses.sheet", device=True),
    shell:
        "{params.run} --config {params.config:q} --code {params.code} > {log:q} 2>&1"


rule sheet:
    input:
        [
            lambda wildcards, subject=subject: of_uses(subject, "results/{subject}/{variant}/sheet/sheet.json")
            for subject in SUBJECTS
        ],


rule animate_by:
    input:
        head=HEAD,
        avatar="results/{subject}/{variant}/avatar.pt",
        frames="results/{subject}/frames/frames.npy",
        index="results/{subject}/frames/frames.json",
        track="results/{subject}/fit/track.npz",
        split="results/{subject}/split.json",
        file=parameter_file,
    output:
        video="results/{subject}/{variant}/animate/{name}/animate.mp4",
        report="results/{subject}/{variant}/animate/{name}/animate.json",
    log:
        "logs/{subject}/{variant}/animate_{name}.log",
    benchmark:
        "benchmarks/{subject}/{variant}/animate_{name}.tsv"
    wildcard_constraints:
        variant="|".join(map(re.escape, VARIANTS)),
        name="|".join(map(re.escape, SETTINGS.animate)) or "(?!)",
    threads: 8
    resources:
        gpu=1,
    params:
        config=use_config("animate"),
        code=model_code_of("avatar.uses.animate"),
        file=content_of_parameter_file,
        run=step("avatar.uses.animate", device=True),
    shell:
        "{params.run} --config {params.config:q} --code {params.code} > {log:q} 2>&1"


rule animate:
    input:
        [lambda wildcards, subject=subject: animations_of(subject) for subject in SUBJECTS],


# One page of all that an avatar is used for.
rule uses_page:
    input:
        videos=uses_files("mp4"),
        pictures=uses_files("png"),
        reports=uses_files("json"),
    output:
        page=report(
            directory("results/{subject}/{variant}/uses"),
            htmlindex="index.html",
            caption="../report/uses.rst",
            category="Avatar",
            labels={"subject": "{subject}", "figure": "uses of {variant}"},
        ),
    log:
        "logs/{subject}/{variant}/uses.log",
    wildcard_constraints:
        variant="|".join(map(re.escape, VARIANTS)),
    params:
        code=code_of("avatar.report.uses_page"),
        run=step("avatar.report.uses_page"),
    shell:
        "{params.run} --code {params.code} > {log:q} 2>&1"


rule uses:
    input:
        [
            lambda wildcards, subject=subject: of_uses(subject, "results/{subject}/{variant}/uses")
            for subject in SUBJECTS
        ],
        # Pages ask for the drivers' probes: what a plan does not hold from the start, Snakemake resolves at the top only.
        probes=expand("results/{who}/probe/probe.json", who=[*SUBJECTS, *(DRIVER + name for name in SETTINGS.drivers)]),


# The paper's test of how an avatar bears less data: the same training on the first half of its frames, in {variant}.half. The
# ordinary rules train, render and score it.
rule split_half:
    input:
        split="results/{subject}/split.json",
    output:
        half="results/{subject}/split_half.json",
    log:
        "logs/{subject}/split_half.log",
    params:
        code=code_of("avatar.uses.half_data"),
        run=step("avatar.uses.half_data"),
    shell:
        "{params.run} --code {params.code} > {log:q} 2>&1"


rule half_data:
    input:
        [lambda wildcards, subject=subject: half_data_of(subject) for subject in SUBJECTS],
        probes=expand("results/{subject}/probe/probe.json", subject=SUBJECTS),
    output:
        csv="results/tables/half_data.csv",
        per_frame="results/tables/half_data_per_frame.csv",
        markdown="results/tables/half_data.md",
        latex="results/tables/half_data.tex",
        regions_markdown="results/tables/half_data_regions.md",
        regions_latex="results/tables/half_data_regions.tex",
    log:
        "logs/half_data.log",
    params:
        config=half_data_config,
        code=code_of("avatar.report.tabulate"),
        run=tabulate_half,
    shell:
        "{params.run} --config {params.config:q} --code {params.code} > {log:q} 2>&1"
