# How much a render flickers over a still stretch, beside the video's own flicker. `snakemake flicker`; none of `all`.


rule flicker_stretch:
    input:
        head=HEAD,
        avatar="results/{subject}/{variant}/avatar.pt",
        frames="results/{subject}/frames/frames.npy",
        index="results/{subject}/frames/frames.json",
        landmarks="results/{subject}/landmarks/landmarks.npz",
        track="results/{subject}/fit/track.npz",
        alpha="results/{subject}/trim/alpha.npy",
        split="results/{subject}/split.json",
        lpips=asset("lpips_alexnet.ckpt"),
    output:
        report="results/{subject}/{variant}/flicker/flicker.json",
        video="results/{subject}/{variant}/flicker/flicker.mp4",
    log:
        "logs/{subject}/{variant}/flicker.log",
    benchmark:
        "benchmarks/{subject}/{variant}/flicker.tsv"
    wildcard_constraints:
        variant="|".join(map(re.escape, VARIANTS)),
    threads: 8
    resources:
        gpu=1,
    params:
        config=use_config("flicker"),
        code=model_code_of("avatar.uses.flicker"),
        asset=sha_of("lpips_alexnet.ckpt"),
        run=step("avatar.uses.flicker", device=True),
    shell:
        "{params.run} --config {params.config:q} --code {params.code} > {log:q} 2>&1"


rule flicker:
    input:
        [
            lambda wildcards, subject=subject: of_uses(subject, "results/{subject}/{variant}/flicker/flicker.json")
            for subject in SUBJECTS
        ],
