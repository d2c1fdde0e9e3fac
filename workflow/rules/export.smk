# Tracked head -> files for other FLAME programs. Nothing else needs them: made when asked for,
# `snakemake results/SUBJECT/export/export.json` for one subject, `snakemake export_all` for all.
# The default head is refused before anything runs.


rule export:
    input:
        head=exportable_head,
        track="results/{subject}/fit/track.npz",
        frames="results/{subject}/frames/frames.npy",
        index="results/{subject}/frames/frames.json",
        alpha="results/{subject}/trim/alpha.npy",
        split="results/{subject}/split.json",
    output:
        nha="results/{subject}/export/nha/tracked_flame_params.npz",
        vhap=directory("results/{subject}/export/vhap"),
        report="results/{subject}/export/export.json",
    log:
        "logs/{subject}/export.log",
    benchmark:
        "benchmarks/{subject}/export.tsv"
    params:
        config=config_of("export"),
        code=code_of("fitting.export"),
        run=step("fitting.export"),
    shell:
        "{params.run} --config {params.config:q} --code {params.code} > {log:q} 2>&1"


# One input function per subject, as for pages: one that fails in probe holds back no other. A rejected one has nothing to export.
rule export_all:
    input:
        [lambda wildcards, subject=subject: export_of(subject) for subject in SUBJECTS],
