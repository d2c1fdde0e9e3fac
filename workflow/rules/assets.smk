# Files that the pipeline does not make itself: fetched once, verified by sha256.


rule fetch:
    output:
        file="resources/assets/{asset}",
    log:
        "logs/assets/{asset}.log",
    params:
        config=lambda wildcards: json.dumps({"path": SETTINGS.assets.get(wildcards.asset)}),
        code=lambda wildcards: sha_of(wildcards.asset),
        run=step("fitting.fetch"),
    shell:
        "{params.run} --config {params.config:q} --code {params.code} > {log:q} 2>&1"


rule head:
    input:
        landmarker=asset("face_landmarker.task"),
    output:
        head="resources/heads/anny.npz",
        report="resources/heads/anny.json",
    log:
        "logs/heads/anny.log",
    threads: 2
    params:
        config=config_of("head"),
        code=code_of("fitting.head"),
        asset=sha_of("face_landmarker.task"),
        run=step("fitting.head", subject="anny"),
    shell:
        "{params.run} --config {params.config:q} --code {params.code} > {log:q} 2>&1"
