# Video -> tracked head. One thread where two subjects can run side by side, more where one step is the bottleneck.


checkpoint probe:
    input:
        video=video_of,
        landmarker=asset("face_landmarker.task"),
    output:
        probe="results/{subject}/probe/probe.json",
    log:
        "logs/{subject}/probe.log",
    benchmark:
        "benchmarks/{subject}/probe.tsv"
    params:
        config=config_of("probe"),
        code=code_of("fitting.probe"),
        video=content_of_video,
        asset=sha_of("face_landmarker.task"),
        run=step("fitting.probe"),
    shell:
        "{params.run} --config {params.config:q} --code {params.code} > {log:q} 2>&1"


rule extract:
    input:
        video=video_of,
        probe="results/{subject}/probe/probe.json",
    output:
        frames="results/{subject}/frames/frames.npy",
        index="results/{subject}/frames/frames.json",
    log:
        "logs/{subject}/extract.log",
    benchmark:
        "benchmarks/{subject}/extract.tsv"
    params:
        config=config_of("extract"),
        code=code_of("fitting.extract"),
        video=content_of_video,
        run=step("fitting.extract"),
    shell:
        "{params.run} --config {params.config:q} --code {params.code} > {log:q} 2>&1"


rule matte:
    input:
        frames="results/{subject}/frames/frames.npy",
        segmenter=asset("selfie_segmentation.tflite"),
    output:
        alpha="results/{subject}/matte/alpha.npy",
    log:
        "logs/{subject}/matte.log",
    benchmark:
        "benchmarks/{subject}/matte.tsv"
    params:
        config=config_of("matte"),
        code=code_of("fitting.matte"),
        asset=sha_of("selfie_segmentation.tflite"),
        run=step("fitting.matte"),
    shell:
        "{params.run} --config {params.config:q} --code {params.code} > {log:q} 2>&1"


rule detect:
    input:
        frames="results/{subject}/frames/frames.npy",
        index="results/{subject}/frames/frames.json",
        landmarker=asset("face_landmarker.task"),
    output:
        landmarks="results/{subject}/landmarks/landmarks.npz",
        report="results/{subject}/landmarks/landmarks.json",
    log:
        "logs/{subject}/detect.log",
    benchmark:
        "benchmarks/{subject}/detect.tsv"
    params:
        config=config_of("detect"),
        code=code_of("fitting.detect"),
        asset=sha_of("face_landmarker.task"),
        run=step("fitting.detect"),
    shell:
        "{params.run} --config {params.config:q} --code {params.code} > {log:q} 2>&1"


rule split:
    input:
        index="results/{subject}/frames/frames.json",
    output:
        split="results/{subject}/split.json",
    log:
        "logs/{subject}/split.log",
    params:
        config=split_config,
        code=code_of("fitting.split"),
        run=step("fitting.split"),
    shell:
        "{params.run} --config {params.config:q} --code {params.code} > {log:q} 2>&1"


rule fit:
    input:
        head=HEAD,
        frames="results/{subject}/frames/frames.npy",
        index="results/{subject}/frames/frames.json",
        landmarks="results/{subject}/landmarks/landmarks.npz",
        alpha="results/{subject}/matte/alpha.npy",
        split="results/{subject}/split.json",
    output:
        track="results/{subject}/fit/track.npz",
        report="results/{subject}/fit/fit.json",
        overlay="results/{subject}/fit/overlay.mp4",
    log:
        "logs/{subject}/fit.log",
    benchmark:
        "benchmarks/{subject}/fit.tsv"
    params:
        config=config_of("fit"),
        code=code_of("fitting.fit"),
        run=step("fitting.fit"),
    shell:
        "{params.run} --config {params.config:q} --code {params.code} > {log:q} 2>&1"


rule trim:
    input:
        head=HEAD,
        alpha="results/{subject}/matte/alpha.npy",
        track="results/{subject}/fit/track.npz",
    output:
        alpha="results/{subject}/trim/alpha.npy",
        report="results/{subject}/trim/trim.json",
    log:
        "logs/{subject}/trim.log",
    benchmark:
        "benchmarks/{subject}/trim.tsv"
    params:
        config=config_of("trim"),
        code=code_of("fitting.trim"),
        run=step("fitting.trim"),
    shell:
        "{params.run} --config {params.config:q} --code {params.code} > {log:q} 2>&1"
