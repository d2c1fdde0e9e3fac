# Numbers -> plots, pages and tables. A rejected subject is a row with its reason; nothing else waits for it.


rule plot:
    input:
        curves=of_subject("results/{{subject}}/{variant}/curve.tsv", VARIANTS),
        per_frames=of_subject("results/{{subject}}/{variant}/metrics/per_frame.csv", ALL_VARIANTS),
        metrics=of_subject("results/{{subject}}/{variant}/metrics/metrics.json", ALL_VARIANTS),
    output:
        curve=report(
            "results/{subject}/plots/training.svg",
            caption="../report/training.rst",
            category="Avatar",
            labels={"subject": "{subject}", "figure": "training curve"},
        ),
        error=report(
            "results/{subject}/plots/error.svg",
            caption="../report/error.rst",
            category="Metrics",
            labels={"subject": "{subject}", "figure": "error of each test frame"},
        ),
    log:
        "logs/{subject}/plot.log",
    params:
        config=config_of("plot"),
        code=code_of("avatar.report.plot"),
        run=step("avatar.report.plot"),
    shell:
        "{params.run} --config {params.config:q} --code {params.code} > {log:q} 2>&1"


# The same step drawn over all subjects: speed against error.
rule plot_speed:
    input:
        metrics=of_accepted("results/{subject}/{variant}/metrics/metrics.json"),
    output:
        speed=report(
            "results/plots/speed.svg",
            caption="../report/speed.rst",
            category="Speed",
            labels={"figure": "speed against error"},
        ),
    log:
        "logs/plot_speed.log",
    params:
        config=config_of("plot"),
        code=code_of("avatar.report.plot"),
        run=step("avatar.report.plot", subject="all"),
    shell:
        "{params.run} --config {params.config:q} --code {params.code} > {log:q} 2>&1"


rule page:
    input:
        probe="results/{subject}/probe/probe.json",
        fit="results/{subject}/fit/fit.json",
        overlay="results/{subject}/fit/overlay.mp4",
        frames="results/{subject}/frames/frames.npy",
        index="results/{subject}/frames/frames.json",
        alpha="results/{subject}/trim/alpha.npy",
        trains=of_subject("results/{{subject}}/{variant}/train.json", VARIANTS),
        renders=of_subject("results/{{subject}}/{variant}/render/test.npy", ALL_VARIANTS),
        reports=of_subject("results/{{subject}}/{variant}/render/render.json", ALL_VARIANTS),
        videos=of_subject("results/{{subject}}/{variant}/render/test.mp4", ALL_VARIANTS),
        metrics=of_subject("results/{{subject}}/{variant}/metrics/metrics.json", ALL_VARIANTS),
        per_frames=of_subject("results/{{subject}}/{variant}/metrics/per_frame.csv", ALL_VARIANTS),
        plots=["results/{subject}/plots/training.svg", "results/{subject}/plots/error.svg"],
    output:
        page=report(
            directory("results/{subject}/page"),
            htmlindex="index.html",
            caption="../report/page.rst",
            category="Avatar",
            labels={"subject": "{subject}", "figure": "page"},
        ),
    log:
        "logs/{subject}/page.log",
    params:
        config=config_of("page"),
        code=code_of("avatar.report.page"),
        run=step("avatar.report.page"),
    shell:
        "{params.run} --config {params.config:q} --code {params.code} > {log:q} 2>&1"


# The page over all subjects. Its links work from disk and inside report.zip (see avatar/report/index_page.py).
rule index:
    input:
        table="results/tables/metrics.csv",
        pages=lambda wildcards: expand("results/{subject}/page", subject=filter(accepted, SUBJECTS)),
        plots="results/plots/speed.svg",
    output:
        page=report(
            directory("results/index"),
            htmlindex="index.html",
            caption="../report/index.rst",
            category="Avatar",
            labels={"subject": "all", "figure": "page"},
        ),
    log:
        "logs/index.log",
    params:
        code=code_of("avatar.report.index_page"),
        run=step("avatar.report.index_page", subject="all"),
    shell:
        "{params.run} --code {params.code} > {log:q} 2>&1"


rule tabulate:
    input:
        probes=expand("results/{subject}/probe/probe.json", subject=SUBJECTS),
        per_frames=of_accepted("results/{subject}/{variant}/metrics/per_frame.csv"),
        metrics=of_accepted("results/{subject}/{variant}/metrics/metrics.json"),
    output:
        csv=report(
            "results/tables/metrics.csv",
            caption="../report/metrics.rst",
            category="Metrics",
            labels={"figure": "table"},
        ),
        per_frame="results/tables/per_frame.csv",
        markdown="results/tables/metrics.md",
        latex="results/tables/metrics.tex",
        regions_markdown="results/tables/regions.md",
        regions_latex="results/tables/regions.tex",
    log:
        "logs/tabulate.log",
    params:
        config=table_config,
        code=code_of("avatar.report.tabulate"),
        run=step("avatar.report.tabulate", subject="all"),
    shell:
        "{params.run} --config {params.config:q} --code {params.code} > {log:q} 2>&1"


# `snakemake available`: the tables and the index page of what exists now, whatever failed. It asks for nothing, so it makes nothing
# else run. A run in which something failed ends with it.
rule available:
    log:
        "logs/available.log",
    params:
        run=available,
    shell:
        "{params.run} > {log:q} 2>&1 && cat results/tables/available.md"
