# Everything a newcomer needs: `make quickstart` and `make test`.
SHELL := /bin/bash
BIN := .venv/bin
PATH := $(CURDIR)/$(BIN):$(PATH)
OUT ?= outputs/quickstart
export PATH

.PHONY: help install quickstart test check bench build clean

help:
	@echo "make quickstart   install, then collect, train, evaluate and record the ball task (~15 min)"
	@echo "make test         the test suite"
	@echo "make check        linter, formatter, type checker, lock file"
	@echo "make bench        benchmarks, ratios measured side by side"
	@echo "make build        wheels and source distributions of every package into dist/"

install: .venv/installed

.venv/installed: pyproject.toml uv.lock collect/pyproject.toml train/pyproject.toml deploy/pyproject.toml
	./install.sh
	@touch $@

test: install
	pytest -m "not slow and not gpu"

check: install
	ruff check .
	ruff format --check .
	mypy
	uv lock --check

bench: install
	@mkdir -p outputs/benchmarks
	for b in simulation planner; do python benchmarks/$$b.py --json outputs/benchmarks/$$b.json || exit 1; done

build: install
	rm -rf dist
	uv build --all-packages --quiet

clean:
	rm -rf dist outputs
