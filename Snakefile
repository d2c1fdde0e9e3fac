# A folder of selfie videos -> volumetric head avatars and one table of metrics.
# `snakemake` alone does everything; what it may be told stands in config/config.yaml.
from snakemake.utils import min_version

min_version("9.25.1")


configfile: "config/config.yaml"


report: "workflow/report/workflow.rst"


include: "workflow/rules/common.smk"
include: "workflow/rules/common_uses.smk"
include: "workflow/rules/common_experiments.smk"
include: "workflow/rules/assets.smk"
include: "workflow/rules/fitting.smk"
include: "workflow/rules/export.smk"
include: "workflow/rules/avatar.smk"
include: "workflow/rules/uses.smk"
include: "workflow/rules/drive.smk"
include: "workflow/rules/flicker.smk"
include: "workflow/rules/report.smk"
include: "workflow/rules/simulate.smk"
include: "workflow/rules/tracking.smk"
include: "workflow/rules/ablation.smk"
include: "workflow/rules/speed_error.smk"
include: "workflow/rules/published.smk"


rule all:
    default_target: True
    input:
        [page_of(subject) for subject in SUBJECTS],
        expand("results/tables/{name}", name=["metrics.csv", "metrics.md", "metrics.tex", "per_frame.csv"]),
        expand("results/tables/regions.{kind}", kind=["md", "tex"]),
        "results/plots/speed.svg",
        "results/index",


onsuccess:
    summarise_at_exit()


onerror:
    summarise_at_exit()
    make_available()
