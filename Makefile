# Two commands from a fresh clone: `make demo` and `make test`. Each sets up what it needs;
# `make setup` does only that.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
CODE := control sim_envs episodes encoders rewards policies benchmarks launch tests

.PHONY: setup demo test lint check format build typings weights weights-markers maze-policy pick-place-policy clean

setup: $(READY)
	@echo "touchgoal is ready: $(BIN)/touchgoal --help"

demo: $(READY)
	$(BIN)/touchgoal doctor --quiet
	$(BIN)/touchgoal demo

# What runs in real time needs a core to itself, so it comes after the rest.
test: $(READY)
	$(BIN)/python -m pytest -n auto --dist worksteal -m "not realtime" --durations 20
	$(BIN)/python -m pytest -m realtime --durations 10

# Format, lint and types.
lint: $(READY) typings
	$(BIN)/ruff format --check $(CODE)
	$(BIN)/ruff check $(CODE)
	$(BIN)/pyright

# The quick loop before every commit.
check: lint
	$(BIN)/python -m pytest -n auto -m "not slow and not realtime"

format: $(READY)
	$(BIN)/ruff check --fix $(CODE)
	$(BIN)/ruff format $(CODE)

# MuJoCo ships no type stubs.
typings: typings/mujoco
typings/mujoco: | $(READY)
	$(BIN)/pybind11-stubgen mujoco -o typings --ignore-all-errors >/dev/null 2>&1

# The source distribution and the wheel made from it; the wheel is tested in a clean environment with
# the tests that the source distribution holds.
build: $(READY)
	rm -rf dist build .venv-wheel
	$(BIN)/python -m build --outdir dist
	$(PYTHON) -m venv .venv-wheel
	.venv-wheel/bin/pip install -c constraints.txt "$$(echo dist/*.whl)[towers,franka,dev]"
	tar -xzf dist/*.tar.gz -C dist
	cd dist/touchgoal-*/ && rm -r src && ../../.venv-wheel/bin/python -m pytest -n auto \
		-m "not slow and not realtime" --ignore tests/test_layout.py \
		--ignore tests/test_results.py --ignore tests/test_documented_commands.py

# How the shipped touch encoder was made: about 25 minutes on 2 cores.
weights: $(READY)
	$(BIN)/touchgoal collect-demos --episodes 80 --seed 100000 --out runs/weights/val
	$(BIN)/touchgoal collect-demos --episodes 240 --seed 0 --out runs/weights/train
	$(BIN)/touchgoal train-encoder align --data runs/weights/train/episodes \
		--validation runs/weights/val/episodes --scale-episodes 60 --out runs/weights/run
	cp runs/weights/run/encoder/* encoders/weights/gelsight_mini_offline/

# The same for the Mini with markers.
MARKERS := --env.sensor gelsight_mini_markers
weights-markers: $(READY)
	$(BIN)/touchgoal collect-demos $(MARKERS) --episodes 80 --seed 100000 --out runs/markers/val
	$(BIN)/touchgoal collect-demos $(MARKERS) --episodes 240 --seed 0 --out runs/markers/train
	$(BIN)/touchgoal train-encoder align --data runs/markers/train/episodes \
		--validation runs/markers/val/episodes --scale-episodes 60 --out runs/markers/run
	cp runs/markers/run/encoder/* encoders/weights/gelsight_mini_markers_offline/

# How the shipped bead-maze policy and its touch encoder were made: hours on 2 cores, most of them
# for the recordings. It learns from demonstrations, and from what the expert would have done where
# the policy has got to by itself: a regression learns that fast, and the diffusion policy learns from
# all of it. (The learners of what ships planned every fourth tick, and it was taught without trials and
# with four DDIM steps, see docs/next_steps.md.)
MAZE := runs/maze
FEEL := --data $(MAZE)/train/episodes --validation $(MAZE)/val/episodes \
	--encoder $(MAZE)/mae/encoder --representation body_twist --train.lr 1e-3
maze-policy: $(READY)
	$(BIN)/touchgoal collect-demos --task bead-maze --episodes 16 --seed 20000 \
		--env.split validation --env.n-wires 16 --out $(MAZE)/val
	$(BIN)/touchgoal collect-demos --task bead-maze --episodes 260 --seed 0 --env.n-wires 260 \
		--out $(MAZE)/train
	$(BIN)/touchgoal train-encoder mae --data $(MAZE)/train/episodes \
		--validation $(MAZE)/val/episodes --frames 30 --mae.epochs 12 --out $(MAZE)/mae
	for round in 0 1; do \
		$(BIN)/touchgoal train-policy $(FEEL) --head regression --trials 0 \
			--train.epochs $$((6 + 2 * round)) --out $(MAZE)/round-$$round && \
		$(BIN)/touchgoal collect-demos --task bead-maze --policy $(MAZE)/round-$$round/policy \
			--episodes 120 --seed 5$${round}000 --env.n-wires 260 --out $(MAZE)/train || exit 1; \
	done
	$(BIN)/touchgoal train-policy $(FEEL) --train.epochs 10 \
		--train.snapshot-epochs 5 --trials 48 --env.disturbance 0.003 --out $(MAZE)/policy
	rm -rf policies/weights/bead_maze && mkdir -p policies/weights
	cp -r $(MAZE)/policy/policy policies/weights/bead_maze

# How the shipped pick-and-place policy was made: about 45 minutes on 2 cores, most of them for its
# pose estimator. What its state estimator reads it learns from the recordings of `make weights` and from pictures of
# placements; what it does, from an expert that answers what to do wherever the policy has got to.
PICK := runs/pick_place
BLIND := --env.no-tactile --env.cameras
LEARN := --task pick-place --data $(PICK)/train/episodes --validation $(PICK)/val/episodes \
	--estimator $(PICK)/estimator/estimator --head regression --representation base_twist --position-noise 0 \
	--train.lr 1e-3 --train.epochs 16 --train.snapshot-epochs 16
pick-place-policy: $(READY)
	$(BIN)/touchgoal train-estimators --data runs/weights/train/episodes \
		--validation runs/weights/val/episodes --out $(PICK)/estimator
	$(BIN)/touchgoal collect-demos --feedback --episodes 20 --seed 120000 $(BLIND) --out $(PICK)/val
	$(BIN)/touchgoal collect-demos --feedback --episodes 120 --seed 20000 $(BLIND) \
		--out $(PICK)/train
	$(BIN)/touchgoal collect-demos --feedback --episodes 120 --seed 20120 $(BLIND) \
		--env.disturbance 0.02 --out $(PICK)/train
	for round in 1 2 3; do \
		$(BIN)/touchgoal train-policy $(LEARN) --trials 0 \
			--out $(PICK)/round-$$round && \
		$(BIN)/touchgoal collect-demos --policy $(PICK)/round-$$round/policy --episodes 120 \
			--seed 3$${round}000 $(BLIND) --out $(PICK)/train || exit 1; \
	done
	$(BIN)/touchgoal train-policy $(LEARN) --trials 40 --out $(PICK)/policy
	rm -rf policies/weights/pick_place && cp -r $(PICK)/policy/policy policies/weights/pick_place

$(READY): pyproject.toml constraints.txt
	@echo "setting up $(VENV): about 1 GB from PyPI, 2 to 3 minutes"
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --disable-pip-version-check -c constraints.txt -e '.[towers,franka,dev]'
	touch $@

clean:
	rm -rf $(VENV) .venv-wheel dist build typings .pytest_cache .ruff_cache
