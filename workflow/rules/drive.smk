# Avatars moved by other videos (`drivers:` in the config): `snakemake drive` for all of them, none of `all`. A driving video is a
# subject `driver.NAME` that goes through probe, extract, matte, detect and fit like any other, and never trains.


ruleorder: drive_split > split


# Nothing of a driving video is tested: all but a short tail determines its identity.
rule drive_split:
    input:
        landmarks="results/{subject}/landmarks/landmarks.npz",
    output:
        split="results/{subject}/split.json",
    log:
        "logs/{subject}/split.log",
    wildcard_constraints:
        subject=re.escape(DRIVER) + ".*",
    params:
        code=code_of("avatar.uses.drive_split"),
        run=step("avatar.uses.drive_split"),
    shell:
        "{params.run} --code {params.code} > {log:q} 2>&1"


rule drive_avatar:
    input:
        head=HEAD,
        avatar="results/{subject}/{variant}/avatar.pt",
        frames="results/{subject}/frames/frames.npy",
        index="results/{subject}/frames/frames.json",
        track="results/{subject}/fit/track.npz",
        split="results/{subject}/split.json",
        driver_track=f"results/{DRIVER}{{driver}}/fit/track.npz",
        driver_frames=f"results/{DRIVER}{{driver}}/frames/frames.npy",
        driver_index=f"results/{DRIVER}{{driver}}/frames/frames.json",
    output:
        video="results/{subject}/{variant}/drive/{driver}/drive.mp4",
        strip="results/{subject}/{variant}/drive/{driver}/strip.png",
        report="results/{subject}/{variant}/drive/{driver}/drive.json",
    log:
        "logs/{subject}/{variant}/drive/{driver}.log",
    benchmark:
        "benchmarks/{subject}/{variant}/drive/{driver}.tsv"
    wildcard_constraints:
        variant="|".join(map(re.escape, VARIANTS)),
        driver="|".join(map(re.escape, SETTINGS.drivers)) or "(?!)",
    threads: 8
    resources:
        gpu=1,
    params:
        config=drive_config,
        code=model_code_of("avatar.uses.drive"),
        run=step("avatar.uses.drive", device=True),
    shell:
        "{params.run} --config {params.config:q} --code {params.code} > {log:q} 2>&1"


# One input function per driver: one that is rejected holds back no other.
rule drive:
    input:
        [lambda wildcards, name=name: drive_of(name) for name in SETTINGS.drivers or [None]],
        # As for `uses`: two probes are asked for one after the other.
        probes=[
            f"results/{who}/probe/probe.json"
            for name, driver in SETTINGS.drivers.items()
            for who in (DRIVER + name, driver.subject)
        ],


# How far fitted heads of one person and of two lie apart, from the videos of the folder: `snakemake identity_calibration`.
rule identity_parts:
    input:
        head=HEAD,
        frames="results/{subject}/frames/frames.npy",
        index="results/{subject}/frames/frames.json",
        landmarks="results/{subject}/landmarks/landmarks.npz",
        alpha="results/{subject}/matte/alpha.npy",
        split="results/{subject}/split.json",
    output:
        row="results/identity/rows/{subject}.json",
    log:
        "logs/identity/{subject}.log",
    benchmark:
        "benchmarks/identity/{subject}.tsv"
    params:
        config=lambda wildcards: json.dumps({"fit": SETTINGS.fit.model_dump(mode="json")}),
        code=code_of("avatar.uses.identity_parts"),
        run=step("avatar.uses.identity_parts"),
    shell:
        "{params.run} --config {params.config:q} --code {params.code} > {log:q} 2>&1"


rule identity_calibration:
    input:
        head=HEAD,
        rows=lambda wildcards: expand("results/identity/rows/{subject}.json", subject=filter(accepted, SUBJECTS)),
    output:
        report="results/identity/identity.json",
        markdown="results/identity/identity.md",
        plot="results/identity/identity.svg",
    log:
        "logs/identity/calibration.log",
    params:
        code=code_of("avatar.uses.identity_calibration"),
        run=step("avatar.uses.identity_calibration", subject="all"),
    shell:
        "{params.run} --code {params.code} > {log:q} 2>&1"
