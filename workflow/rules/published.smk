# `snakemake compare_published`: avatars beside published renders, on the frames of the comparison videos that the config names.
# The driving panel is a subject of its own, `published.NAME`, through the pipeline's own rules; nothing in `all` asks for it.


rule published_panel:
    input:
        video=comparison_video,
    output:
        video="results/published/{comparison}/driving.mp4",
    log:
        "logs/published/{comparison}/panel.log",
    params:
        config=comparison_config("test_frames", max_frames=SETTINGS.extract.max_frames),
        code=code_of("avatar.published.panel"),
        video=lambda wildcards: checks.fingerprint(Path(comparison_of(wildcards).video).expanduser()),
        run=step("avatar.published.panel"),
    shell:
        "{params.run} --config {params.config:q} --code {params.code} > {log:q} 2>&1"


rule published_render:
    input:
        head=HEAD,
        avatar=f"results/{PUBLISHED}{{comparison}}/{{variant}}/avatar.pt",
        index=f"results/{PUBLISHED}{{comparison}}/frames/frames.json",
        track=f"results/{PUBLISHED}{{comparison}}/fit/track.npz",
        split=f"results/{PUBLISHED}{{comparison}}/split.json",
    output:
        png=directory("results/published/{comparison}/{variant}/png"),
        opacity="results/published/{comparison}/{variant}/opacity.npy",
        report="results/published/{comparison}/{variant}/render.json",
    log:
        "logs/published/{comparison}/{variant}/render.log",
    benchmark:
        "benchmarks/published/{comparison}/{variant}/render.tsv"
    wildcard_constraints:
        variant="|".join(map(re.escape, VARIANTS)),
    threads: 8
    resources:
        gpu=1,
    params:
        config=published_render_config,
        code=model_code_of("avatar.published.render"),
        run=step("avatar.published.render", device=True),
    shell:
        "{params.run} --config {params.config:q} --code {params.code} > {log:q} 2>&1"


rule published_place:
    input:
        index=f"results/{PUBLISHED}{{comparison}}/frames/frames.json",
        split=f"results/{PUBLISHED}{{comparison}}/split.json",
        render=f"results/{PUBLISHED}{{comparison}}/{{predictor}}/render/test.npy",
        report=f"results/{PUBLISHED}{{comparison}}/{{predictor}}/render/render.json",
    output:
        png=directory("results/published/{comparison}/{predictor}/png"),
        opacity="results/published/{comparison}/{predictor}/opacity.npy",
        report="results/published/{comparison}/{predictor}/render.json",
    log:
        "logs/published/{comparison}/{predictor}/place.log",
    params:
        config=lambda wildcards: json.dumps({"stride": comparison_of(wildcards).stride}),
        code=code_of("avatar.published.place"),
        run=step("avatar.published.place"),
    shell:
        "{params.run} --config {params.config:q} --code {params.code} > {log:q} 2>&1"


# A method is a variant, a predictor, or `panel.NAME` of the video itself.
rule published_score:
    input:
        unpack(published_pictures),
        video=comparison_video,
        index=f"results/{PUBLISHED}{{comparison}}/frames/frames.json",
        matte=f"results/{PUBLISHED}{{comparison}}/matte/alpha.npy",
        trim=f"results/{PUBLISHED}{{comparison}}/trim/alpha.npy",
        landmarks=f"results/{PUBLISHED}{{comparison}}/landmarks/landmarks.npz",
        track=f"results/{PUBLISHED}{{comparison}}/fit/track.npz",
        split=f"results/{PUBLISHED}{{comparison}}/split.json",
        lpips=asset("lpips_alexnet.ckpt"),
    output:
        per_frame="results/published/{comparison}/{method}/per_frame.csv",
        metrics="results/published/{comparison}/{method}/metrics.json",
    log:
        "logs/published/{comparison}/{method}/score.log",
    wildcard_constraints:
        method="|".join([*map(re.escape, ALL_VARIANTS), r"panel\.[A-Za-z0-9_-]+"]),
    params:
        config=published_score_config,
        code=code_of("avatar.published.score"),
        video=lambda wildcards: checks.fingerprint(Path(comparison_of(wildcards).video).expanduser()),
        asset=sha_of("lpips_alexnet.ckpt"),
        run=step("avatar.published.score"),
    shell:
        "{params.run} --config {params.config:q} --code {params.code} > {log:q} 2>&1"


rule published_table:
    input:
        metrics=of_methods("metrics.json"),
        per_frames=of_methods("per_frame.csv"),
    output:
        csv="results/published/{comparison}/table.csv",
        markdown="results/published/{comparison}/table.md",
        latex="results/published/{comparison}/table.tex",
    log:
        "logs/published/{comparison}/table.log",
    params:
        code=code_of("avatar.published.table"),
        run=step("avatar.published.table"),
    shell:
        "{params.run} --code {params.code} > {log:q} 2>&1"


rule published_strip:
    input:
        video=comparison_video,
        png=expand("results/published/{{comparison}}/{variant}/png", variant=VARIANTS),
        avatars=expand(f"results/{PUBLISHED}{{{{comparison}}}}/{{variant}}/avatar.pt", variant=VARIANTS),
    output:
        picture="results/published/{comparison}/strip.png",
    log:
        "logs/published/{comparison}/strip.log",
    params:
        config=comparison_config(variants=list(VARIANTS)),
        code=code_of("avatar.published.strip"),
        run=step("avatar.published.strip"),
    shell:
        "{params.run} --config {params.config:q} --code {params.code} > {log:q} 2>&1"


rule compare_published:
    input:
        compared,
