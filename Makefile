BIN := .venv/bin

.DEFAULT_GOAL := help
.PHONY: help setup demo quick test test-long test-narrow docs lint format clean

help:  ## list the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "make %-12s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

setup:  ## make .venv, install the pinned dependencies, check LLVM
	@.ci/setup

demo: setup  ## from a procedural scene to an evaluated neural renderer (13 to 26 minutes on two cores)
	$(BIN)/tron-eval benchmark=demo output_dir=outputs/demo
	@echo "report: $(CURDIR)/outputs/demo/report.html"

quick: setup  ## the tests that neither render nor start a process, in two processes
	$(BIN)/python -m pytest -m "not long and not render and not process" -n 2 --dist loadfile

test: setup  ## the fast tests, in two processes
	$(BIN)/python -m pytest -m "not long" -n 2 --dist loadfile

test-long: setup  ## the tests marked long, in two processes
	$(BIN)/python -m pytest -m long -n 2 --dist loadfile --no-loadscope-reorder || [ $$? -eq 5 ]  # 5: pytest collected none

test-narrow: setup  ## the fast tests with vectors half as wide, as on another processor
	TRON_LLVM_WIDTH=$$(grep -qw avx512vl /proc/cpuinfo 2>/dev/null && echo 8 || echo 4) \
		$(BIN)/python -m pytest -m "not long" -n 2 --dist loadfile

docs: setup  ## these pages and the reference as a site in outputs/site, links checked
	$(BIN)/python -m mkdocs build --strict

lint: setup  ## style, formatting, who may import whom, types
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/lint-imports
	$(BIN)/pyright

format: setup  ## let ruff mend and format the code
	$(BIN)/ruff check --fix
	$(BIN)/ruff format

clean:  ## remove caches, build results and .venv; outputs/ stays
	rm -rf .venv build dist *.egg-info .pytest_cache .ruff_cache .import_linter_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
