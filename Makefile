# make demo: everything on the demo clip; make test: linters and all tests. Both need Python 3.11, gcc and make.
PYTHON ?= python3.11
BIN := .venv/bin
DEMO := build/demo/videos
ASSETS := face_landmarker.task selfie_segmentation.tflite lpips_alexnet.ckpt lpips_vgg16.ckpt carphone.mp4

.PHONY: demo test lint clean
.DELETE_ON_ERROR:
.SECONDARY:

.venv/installed: requirements.txt pyproject.toml workflow/headless_opencv/pyproject.toml
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -r requirements.txt
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation -e .
	$(BIN)/python -m workflow.environment
	touch $@

.venv: .venv/installed

.venv/tested: .venv/installed requirements-test.txt
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps -r requirements-test.txt
	touch $@

resources/assets/%: | .venv/installed
	$(BIN)/python -m fitting.fetch --subject $* --config '{"path": null}' --output file=$@

$(DEMO)/carphone.mp4: resources/assets/carphone.mp4
	mkdir -p $(DEMO)
	cp $< $@

demo: .venv/installed $(DEMO)/carphone.mp4
	$(BIN)/snakemake --config videos=$(DEMO)
	@echo
	@cat results/tables/metrics.md
	@echo
	@echo "page: results/carphone/page/index.html"

lint: .venv/installed
	$(BIN)/ruff check .
	$(BIN)/snakefmt --check --compact-diff Snakefile workflow

test: lint .venv/tested $(ASSETS:%=resources/assets/%)
	$(BIN)/python -m workflow.environment
	$(BIN)/python -m pytest

clean:
	rm -rf build .pytest_cache .ruff_cache *.egg-info
