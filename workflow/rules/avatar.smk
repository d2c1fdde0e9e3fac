# Tracked head -> avatar -> rendered test frames -> scores. The wildcard `variant` is a preset plus overrides of avatar keys;
# two trivial predictors stand beside the variants and are scored like them.


# The folder {variant}/checkpoints is no output: Snakemake would delete it before a run is continued.
rule train:
    input:
        head=HEAD,
        frames="results/{subject}/frames/frames.npy",
        alpha="results/{subject}/trim/alpha.npy",
        track="results/{subject}/fit/track.npz",
        split=split_of,
        vgg=perceptual_of,
    output:
        avatar="results/{subject}/{variant}/avatar.pt",
        curve="results/{subject}/{variant}/curve.tsv",
        report="results/{subject}/{variant}/train.json",
    log:
        "logs/{subject}/{variant}/train.log",
    benchmark:
        "benchmarks/{subject}/{variant}/train.tsv"
    wildcard_constraints:
        variant="|".join(map(re.escape, TRAINED)),
    threads: 8
    resources:
        gpu=1,
    params:
        config=variant_config("train"),
        code=model_code_of("avatar.train"),
        asset=perceptual_sha_of,
        run=step("avatar.train", device=True),
    shell:
        "{params.run} --config {params.config:q} --code {params.code} > {log:q} 2>&1"


rule render:
    input:
        head=HEAD,
        avatar="results/{subject}/{variant}/avatar.pt",
        frames="results/{subject}/frames/frames.npy",
        index="results/{subject}/frames/frames.json",
        track="results/{subject}/fit/track.npz",
        alpha="results/{subject}/trim/alpha.npy",
        split="results/{subject}/split.json",
    output:
        render="results/{subject}/{variant}/render/test.npy",
        report="results/{subject}/{variant}/render/render.json",
        video="results/{subject}/{variant}/render/test.mp4",
    log:
        "logs/{subject}/{variant}/render.log",
    benchmark:
        "benchmarks/{subject}/{variant}/render.tsv"
    wildcard_constraints:
        variant="|".join(map(re.escape, TRAINED)),
    threads: 8
    resources:
        gpu=1,
    params:
        config=variant_config("render"),
        code=model_code_of("avatar.render"),
        run=step("avatar.render", device=True),
    shell:
        "{params.run} --config {params.config:q} --code {params.code} > {log:q} 2>&1"


rule baseline:
    input:
        head=HEAD,
        frames="results/{subject}/frames/frames.npy",
        index="results/{subject}/frames/frames.json",
        alpha="results/{subject}/trim/alpha.npy",
        track="results/{subject}/fit/track.npz",
        split="results/{subject}/split.json",
    output:
        render="results/{subject}/{predictor}/render/test.npy",
        report="results/{subject}/{predictor}/render/render.json",
        video="results/{subject}/{predictor}/render/test.mp4",
    log:
        "logs/{subject}/{predictor}/render.log",
    params:
        config=predictor_config,
        code=code_of("avatar.baseline"),
        run=step("avatar.baseline"),
    shell:
        "{params.run} --config {params.config:q} --code {params.code} > {log:q} 2>&1"


rule evaluate:
    input:
        frames="results/{subject}/frames/frames.npy",
        alpha="results/{subject}/trim/alpha.npy",
        landmarks="results/{subject}/landmarks/landmarks.npz",
        track="results/{subject}/fit/track.npz",
        split="results/{subject}/split.json",
        render="results/{subject}/{variant}/render/test.npy",
        report="results/{subject}/{variant}/render/render.json",
        train=training_of,
        lpips=[asset(f"lpips_{network}.ckpt") for network in SETTINGS.evaluate.lpips],
    output:
        per_frame="results/{subject}/{variant}/metrics/per_frame.csv",
        metrics="results/{subject}/{variant}/metrics/metrics.json",
    log:
        "logs/{subject}/{variant}/evaluate.log",
    benchmark:
        "benchmarks/{subject}/{variant}/evaluate.tsv"
    threads: 2
    params:
        config=config_of("evaluate"),
        code=code_of("avatar.evaluate"),
        asset=" ".join(sha_of(f"lpips_{network}.ckpt") for network in SETTINGS.evaluate.lpips),
        run=step("avatar.evaluate"),
    shell:
        "{params.run} --config {params.config:q} --code {params.code} > {log:q} 2>&1"
