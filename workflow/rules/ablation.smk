# `snakemake ablation`: the paper's section 4.4 at a small size, sources of features against each other. Nothing in `all` asks for it.
# One small file a subject, cell and seed, so that what was interrupted goes on; the simulated subject goes through the pipeline's
# own rules. Cells are small enough for one core and take no GPU, so that their figures are the same everywhere.


rule ablation_data:
    input:
        unpack(of_simulated({"matte": "simulated/truth/{clip}_alpha.npy"})),
        head=HEAD,
        frames="results/{subject}/frames/frames.npy",
        index="results/{subject}/frames/frames.json",
        alpha="results/{subject}/trim/alpha.npy",
        track="results/{subject}/fit/track.npz",
        split="results/{subject}/split.json",
    output:
        frames="results/ablation/data/{subject}/frames.npy",
        alpha="results/ablation/data/{subject}/alpha.npy",
        track="results/ablation/data/{subject}/track.npz",
        split="results/ablation/data/{subject}/split.json",
        half="results/ablation/data/{subject}/half.json",
        four="results/ablation/data/{subject}/four.json",
    log:
        "logs/ablation/{subject}/data.log",
    params:
        config=ablation_data_config,
        code=code_of("avatar.ablation.data"),
        run=step("avatar.ablation.data"),
    shell:
        "{params.run} --config {params.config:q} --code {params.code} > {log:q} 2>&1"


rule ablation_truth:
    input:
        head=HEAD,
        rich="resources/heads/anny_rich.npz",
        truth="simulated/truth/{clip}.npz",
        index=f"results/{benchmark_settings.PREFIX}{{clip}}/frames/frames.json",
        track=f"results/{benchmark_settings.PREFIX}{{clip}}/fit/track.npz",
        split=f"results/ablation/data/{benchmark_settings.PREFIX}{{clip}}/split.json",
    output:
        head=f"results/ablation/data/{benchmark_settings.PREFIX}{{clip}}/true_head.npz",
        track=f"results/ablation/data/{benchmark_settings.PREFIX}{{clip}}/true_track.npz",
        doubled=f"results/ablation/data/{benchmark_settings.PREFIX}{{clip}}/doubled.npz",
    log:
        "logs/ablation/{clip}/truth.log",
    params:
        config=lambda wildcards: ablation_data_config(
            SimpleNamespace(subject=benchmark_settings.PREFIX + wildcards.clip)
        ),
        code=code_of("avatar.ablation.truth"),
        run=step("avatar.ablation.truth", subject="simulated"),
    shell:
        "{params.run} --config {params.config:q} --code {params.code} > {log:q} 2>&1"


# The folder rows/{subject}/{cell}/{seed} is no output: it holds the checkpoint of a cell that has begun.
rule ablation_cell:
    input:
        unpack(ablation_inputs),
        frames="results/ablation/data/{subject}/frames.npy",
        alpha="results/ablation/data/{subject}/alpha.npy",
        lpips=asset("lpips_alexnet.ckpt"),
    output:
        row="results/ablation/rows/{subject}/{cell}/{seed}.json",
        picture="results/ablation/rows/{subject}/{cell}/{seed}.png",
    log:
        "logs/ablation/{subject}/{cell}_{seed}.log",
    wildcard_constraints:
        cell="|".join(ablation_settings.CELLS),
        seed=r"\d+",
    params:
        config=ablation_config,
        code=ablation_code,
        asset=sha_of("lpips_alexnet.ckpt"),
        run=step("avatar.ablation.cell", one_thread=True),
    shell:
        "{params.run} --config {params.config:q} --code {params.code} > {log:q} 2>&1"


rule ablation:
    input:
        rows=ablation_rows,
    output:
        csv="results/ablation/ablation.csv",
        markdown="results/ablation/ablation.md",
        latex="results/ablation/ablation.tex",
        plot="results/ablation/ablation.svg",
    log:
        "logs/ablation/table.log",
    params:
        config="{}",
        code=code_of("avatar.ablation.table"),
        run=step("avatar.ablation.table", subject="ablation"),
    shell:
        "{params.run} --config {params.config:q} --code {params.code} > {log:q} 2>&1"
