# Everything a newcomer needs: `make quickstart` and `make test`.
SHELL := /bin/bash
.SHELLFLAGS := -o pipefail -c
BIN := .venv/bin
PATH := $(CURDIR)/$(BIN):$(PATH)
OUT ?= outputs/quickstart
# Processes that share the tests, a file at a time; a test has one computing thread.
WORKERS ?= 2
export PATH
# Threads that spin at barriers for long slow each other down tenfold beside any other program.
export GOMP_SPINCOUNT := 20000
# Without bytecode, every process compiles PyTorch's sources anew, which doubles its start.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: help install demo ship quickstart test check docs bench build cards clean

help:
	@echo "make demo         install, then let the policy that ships with egovcp play all tasks (1 min)"
	@echo "make quickstart   install, then collect, train, evaluate and record the ball task (about 15 min)"
	@echo "make test         the test suite"
	@echo "make check        linter, formatter, type checker, lock file, docs"
	@echo "make docs         the documentation site, in site/"
	@echo "make bench        benchmarks, ratios measured side by side"
	@echo "make cards        dataset_cards/ from a dataset of 1000 episodes of each task (collected if need be)"
	@echo "make ship         the policy that ships with egovcp: make ship FROM=runs/contact/checkpoints/last/pretrained_model"
	@echo "make build        wheels and source distributions of every package into dist/"

install: .venv/installed

.venv/installed: pyproject.toml uv.lock collect/pyproject.toml train/pyproject.toml deploy/pyproject.toml experiment/pyproject.toml $(wildcard plugins/*/pyproject.toml)
	./install.sh
	@touch $@

test: install
	pytest --numprocesses=$(WORKERS) --max-worker-restart=1 --dist=loadfile --no-loadscope-reorder -m "not slow and not gpu"

demo: install
	rm -rf outputs/demo
	egovcp-demo --output_dir=outputs/demo

# Its card names it `contact` in this folder.
ship: install
	@test -f "$(FROM)/manifest.json" || { echo "ship: error: FROM=$(FROM): expected the folder of a policy" >&2; exit 2; }
	rm -rf egovcp/pretrained/contact
	egovcp-export --policy.path="$(FROM)" --output_dir=egovcp/pretrained/contact

POLICY := $(OUT)/policy/checkpoints/last/pretrained_model

quickstart: install
	@test ! -e $(OUT) || { echo "quickstart: error: $(OUT) exists; remove it or choose another: make quickstart OUT=..." >&2; exit 2; }
	egovcp-collect --task=ball --dataset.repo_id=me/egovcp-ball --dataset.root=$(OUT)/dataset \
	  --episodes=4000 --seed=0
	egovcp-train --dataset.repo_id=me/egovcp-ball --dataset.root=$(OUT)/dataset \
	  --output_dir=$(OUT)/policy --preset=laptop --seed=0
	egovcp-eval --policy.path=$(POLICY) --task=ball --episodes=80 \
	  --output_dir=$(OUT)/eval | tee $(OUT)/table.txt
	egovcp-deploy --policy.path=$(POLICY) --robot.type=sim --task=ball --episodes=1 \
	  --output_dir=$(OUT)/rollouts
	@cd $(OUT) && for kind in mcap rrd png gif; do cp rollouts/rollout-0.$$kind rollout.$$kind; done
	@echo; cat $(OUT)/table.txt; echo
	@echo "dataset   $(OUT)/dataset          lerobot-dataset-viz --repo-id me/egovcp-ball --root $(OUT)/dataset --episode-index 0"
	@echo "policy    $(POLICY)"
	@echo "figures   $(OUT)/eval/eval.json"
	@echo "rollout   $(OUT)/rollout.rrd      .venv/bin/rerun $(OUT)/rollout.rrd"
	@echo "          $(OUT)/rollout.mcap     Foxglove or Rerun"
	@echo "          $(OUT)/rollout.png, rollout.gif"
	@echo "next      train longer with more data (README), or another task: egovcp-collect --task=wall --help"

check: install docs
	ruff check .
	ruff format --check .
	mypy
	uv lock --check

# The plugins print advertisements of other tools.
docs: install
	NO_MKDOCS_2_WARNING=1 DISABLE_MKDOCS_2_WARNING=true mkdocs build --quiet

bench: install
	@mkdir -p outputs/benchmarks
	for b in simulation writer memory loader train_step planner tick controller; do python benchmarks/$$b.py --json outputs/benchmarks/$$b.json || exit 1; done

build: install
	rm -rf dist
	uv build --all-packages --quiet

# A dataset that is there already is used as it is.
CARDS ?= outputs/cards
CARD_EPISODES ?= 1000

cards: install
	for task in ball wall arch; do \
	  test -d $(CARDS)/$$task || egovcp-collect --task=$$task --episodes=$(CARD_EPISODES) --seed=0 \
	    --dataset.root=$(CARDS)/$$task || exit 1; \
	  egovcp-dataset card $(CARDS)/$$task --repo_id=egovcp/$$task \
	    --output=dataset_cards/$$task.md || exit 1; \
	done

clean:
	rm -rf dist outputs
