# Truth to test against: simulated clips with known parameters. Nothing in `all` asks for them.
# A video's name says kind and seed, and, where they differ from the config's, frames and hair: profile_0_120_short.mp4
#   snakemake --config videos=resources/assets -- simulated/videos/blink_3.mp4   (any folder with a video does: none is read)
#   snakemake --config videos=simulated/videos                                    (the pipeline on the clips)
SIMULATED_KINDS = ("still", "slow", "fast", "jump", "profile", "blink", "talk")


# More identity components, from other random heads, than the head that is fitted.
rule head_rich:
    input:
        landmarker=asset("face_landmarker.task"),
    output:
        head="resources/heads/anny_rich.npz",
        report="resources/heads/anny_rich.json",
    log:
        "logs/heads/anny_rich.log",
    threads: 2
    params:
        config=json.dumps({"shape_components": 150, "samples": 1000, "renders": 50}),
        code=code_of("fitting.head", ("fitting.anny_head",)),
        asset=sha_of("face_landmarker.task"),
        run=step("fitting.head", subject="anny_rich"),
    shell:
        "{params.run} --config {params.config:q} --code {params.code} > {log:q} 2>&1"


rule simulate:
    input:
        head="resources/heads/anny_rich.npz",
    output:
        video="simulated/videos/{kind}_{seed}{options}.mp4",
        truth="simulated/truth/{kind}_{seed}{options}.npz",
        alpha="simulated/truth/{kind}_{seed}{options}_alpha.npy",
    log:
        "logs/simulate/{kind}_{seed}{options}.log",
    wildcard_constraints:
        kind="|".join(SIMULATED_KINDS),
        seed=r"0|[1-9]\d*",
        options=r"(_[1-9]\d*)?(_(bald|short|full))?",
    params:
        config=simulate_config,
        code=code_of("fitting.simulate"),
        run=step("fitting.simulate", subject="simulated"),
    shell:
        "{params.run} --config {params.config:q} --code {params.code} > {log:q} 2>&1"


# One clip of every kind.
rule simulated:
    input:
        expand("simulated/videos/{kind}_0.mp4", kind=SIMULATED_KINDS),
