# `snakemake speed_error`: one subject's error against seconds and operations, and what more work costs. Nothing in `all` asks for it.
# One small file a training, rendering and amount of work, so that what was interrupted goes on. Every timed job takes all cores:
# one that ran beside another would be timed wrong.


rule speed_training:
    input:
        unpack(speed_assets),
        **TIMED_INPUTS,
    output:
        avatar="results/speed_error/{subject}/trainings/{training}/avatar.pt",
        curve="results/speed_error/{subject}/trainings/{training}/curve.tsv",
        report="results/speed_error/{subject}/trainings/{training}/train.json",
    log:
        "logs/speed_error/{subject}/trainings/{training}.log",
    wildcard_constraints:
        training="|".join(SPEED_TRAININGS),
    threads: ALL_CORES
    resources:
        gpu=1,
    params:
        config=lambda wildcards: speed_settings.training_config(PRESETS, wildcards.training).model_dump_json(),
        code=speed_code("avatar.speed_error.training", lambda name: name),
        run=step("avatar.speed_error.training", device=True),
    shell:
        "{params.run} --config {params.config:q} --code {params.code} > {log:q} 2>&1"


rule speed_rendering:
    input:
        **TIMED_INPUTS,
        avatar=lambda wildcards: speed_training_of(SPEED_CELLS[wildcards.cell].training, "avatar.pt"),
        report=lambda wildcards: speed_training_of(SPEED_CELLS[wildcards.cell].training, "train.json"),
        landmarks="results/{subject}/landmarks/landmarks.npz",
        lpips=asset("lpips_alexnet.ckpt"),
    output:
        row="results/speed_error/{subject}/rows/{cell}.json",
        render="results/speed_error/{subject}/rows/{cell}.npy",
    log:
        "logs/speed_error/{subject}/rows/{cell}.log",
    wildcard_constraints:
        cell="|".join(map(re.escape, SPEED_CELLS)),
    threads: ALL_CORES
    resources:
        gpu=1,
    params:
        config=lambda wildcards: SPEED_CELLS[wildcards.cell].config.model_dump_json(),
        code=speed_code("avatar.speed_error.rendering", lambda name: SPEED_CELLS[name].training),
        asset=sha_of("lpips_alexnet.ckpt"),
        run=step("avatar.speed_error.rendering", device=True),
    shell:
        "{params.run} --config {params.config:q} --code {params.code} > {log:q} 2>&1"


rule speed_cost:
    input:
        **TIMED_INPUTS,
        avatar=lambda wildcards: speed_training_of(SPEED_COSTS[wildcards.cost].train.representation, "avatar.pt"),
        report=lambda wildcards: speed_training_of(SPEED_COSTS[wildcards.cost].train.representation, "train.json"),
    output:
        row="results/speed_error/{subject}/costs/{cost}.json",
    log:
        "logs/speed_error/{subject}/costs/{cost}.log",
    wildcard_constraints:
        cost="|".join(SPEED_COSTS),
    threads: ALL_CORES
    resources:
        gpu=1,
    params:
        config=lambda wildcards: SPEED_COSTS[wildcards.cost].model_dump_json(),
        code=speed_code("avatar.speed_error.cost", lambda name: SPEED_COSTS[name].train.representation),
        run=step("avatar.speed_error.cost", device=True),
    shell:
        "{params.run} --config {params.config:q} --code {params.code} > {log:q} 2>&1"


rule speed_table:
    input:
        rows=expand("results/speed_error/{{subject}}/rows/{cell}.json", cell=SPEED_CELLS),
        renders=expand("results/speed_error/{{subject}}/rows/{cell}.npy", cell=SPEED_CELLS),
        curves=expand("results/speed_error/{{subject}}/trainings/{training}/curve.tsv", training=SPEED_TRAININGS),
        costs=expand("results/speed_error/{{subject}}/costs/{cost}.json", cost=SPEED_COSTS),
    output:
        csv="results/speed_error/{subject}/table.csv",
        markdown="results/speed_error/{subject}/table.md",
        latex="results/speed_error/{subject}/table.tex",
        plot="results/speed_error/{subject}/plot.svg",
        report="results/speed_error/{subject}/report.json",
    log:
        "logs/speed_error/{subject}/table.log",
    params:
        config=speed_settings.table_config(PRESETS).model_dump_json(),
        code=code_of("avatar.speed_error.table"),
        run=step("avatar.speed_error.table"),
    shell:
        "{params.run} --config {params.config:q} --code {params.code} > {log:q} 2>&1"


rule speed_error:
    input:
        speed_error_files,
