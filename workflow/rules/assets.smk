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
        unpack(head_files),
        landmarker=asset("face_landmarker.task"),
    output:
        head=HEAD,
        report=HEAD.replace(".npz", ".json"),
    log:
        f"logs/heads/{SETTINGS.head.model}.log",
    threads: 2
    params:
        config=config_of("head"),
        code=code_of("fitting.head", (HEAD_SOURCE,)),
        asset=sha_of("face_landmarker.task"),
        files=content_of_head_files,
        run=step("fitting.head", subject=SETTINGS.head.model),
    shell:
        "{params.run} --config {params.config:q} --code {params.code} > {log:q} 2>&1"
