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

.PHONY: help install quickstart test check docs bench build cards clean

help:
	@echo "make quickstart   install, then collect, train, evaluate and record the ball task (10 to 20 min)"
	@echo "make test         the test suite"
	@echo "make check        linter, formatter, type checker, lock file, docs"
	@echo "make docs         the documentation site, in site/"
	@echo "make bench        benchmarks, ratios measured side by side"
	@echo "make cards        dataset_cards/ from a dataset of 1000 episodes of each task (collected if need be)"
	@echo "make build        wheels and source distributions of every package into dist/"

install: .venv/installed

.venv/installed: pyproject.toml uv.lock collect/pyproject.toml train/pyproject.toml deploy/pyproject.toml experiment/pyproject.toml $(wildcard plugins/*/pyproject.toml)
	./install.sh
	@touch $@

test: install
	pytest --numprocesses=$(WORKERS) --dist=loadfile --no-loadscope-reorder -m "not slow and not gpu"

# Laptop scale: the throw comes at once, so that each simulated second teaches something, and the
# robot stands by the stance law, which is cheaper to simulate and keeps the camera still. Hands
# that stay for a while where the walk puts them show what that is worth.
WALK := --eta=1 --step_ticks="[5,15]"
SCENES := --env.controller=stance --env.ball_episode.ticks=46 --env.ball_episode.event_ticks="[4,10]"
POLICY := $(OUT)/policy/checkpoints/last/pretrained_model

quickstart: install
	@test ! -e $(OUT) || { echo "quickstart: error: $(OUT) exists; remove it or choose another: make quickstart OUT=..." >&2; exit 2; }
	egovcp-collect --task=ball --dataset.repo_id=me/egovcp-ball --dataset.root=$(OUT)/dataset \
	  --episodes=5000 --seed=0 $(WALK) $(SCENES)
	egovcp-train --dataset.repo_id=me/egovcp-ball --dataset.root=$(OUT)/dataset \
	  --output_dir=$(OUT)/policy --preset=laptop --seed=0
	egovcp-eval --policy.path=$(POLICY) --task=ball --episodes=80 \
	  --output_dir=$(OUT)/eval $(SCENES) --env.ball_episode.empty_probability=0 | tee $(OUT)/table.txt
	egovcp-deploy --policy.path=$(POLICY) --robot.type=sim --task=ball --episodes=1 \
	  --output_dir=$(OUT)/rollouts $(SCENES) --env.ball_episode.empty_probability=0
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
	    --output=dataset_cards/$$task.md --assets=assets/$$task || exit 1; \
	done

clean:
	rm -rf dist outputs
