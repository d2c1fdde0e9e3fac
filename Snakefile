# A folder of selfie videos -> volumetric head avatars and one table of metrics.
# `snakemake` alone does everything; what it may be told stands in config/config.yaml.
from snakemake.utils import min_version

min_version("9.25.1")


configfile: "config/config.yaml"


report: "workflow/report/workflow.rst"


include: "workflow/rules/common.smk"
include: "workflow/rules/assets.smk"
include: "workflow/rules/fitting.smk"
include: "workflow/rules/export.smk"
include: "workflow/rules/avatar.smk"
include: "workflow/rules/report.smk"
include: "workflow/rules/simulate.smk"
include: "workflow/rules/tracking.smk"
include: "workflow/rules/ablation.smk"


rule all:
    default_target: True
    input:
        [page_of(subject) for subject in SUBJECTS],
        "results/tables/metrics.csv",
        "results/tables/metrics.md",
        "results/plots/speed.svg",


onsuccess:
    summarise_at_exit()


onerror:
    summarise_at_exit()
