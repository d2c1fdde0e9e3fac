# `snakemake tracking_benchmark`: speed against error of the fit, by solver, iterations and terms. Nothing in `all` asks for it.
# One small file a clip and setting, so that what was interrupted goes on; simulated clips go through the pipeline's own rules.


# All cores (1024 means as many as are given) for one thread: a fit that is timed has nothing beside it.
rule benchmark_fit:
    input:
        unpack(truth_of),
        head=HEAD,
        frames="results/{subject}/frames/frames.npy",
        index="results/{subject}/frames/frames.json",
        landmarks="results/{subject}/landmarks/landmarks.npz",
        alpha="results/{subject}/matte/alpha.npy",
        split="results/{subject}/split.json",
    output:
        row="results/tracking_benchmark/rows/{subject}/{setting}.json",
    log:
        "logs/tracking_benchmark/{subject}/{setting}.log",
    wildcard_constraints:
        setting="|".join(benchmark_settings.SETTINGS),
    threads: 1024
    params:
        config=benchmark_config,
        code=code_of("fitting.benchmark"),
        run=step("fitting.benchmark", one_thread=True),
    shell:
        "{params.run} --config {params.config:q} --code {params.code} > {log:q} 2>&1"


rule tracking_benchmark:
    input:
        rows=benchmark_rows,
    output:
        csv="results/tracking_benchmark/tracking.csv",
        markdown="results/tracking_benchmark/tracking.md",
        plot="results/tracking_benchmark/tracking.svg",
    log:
        "logs/tracking_benchmark/compare.log",
    params:
        config="{}",
        code=code_of("avatar.report.compare"),
        run=step("avatar.report.compare", subject="tracking_benchmark"),
    shell:
        "{params.run} --config {params.config:q} --code {params.code} > {log:q} 2>&1"
