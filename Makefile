# Two commands from a fresh clone: `make demo` and `make test`. Each sets up what it needs;
# `make setup` does only that.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
CODE := runtime control sim_envs episodes encoders rewards policies benchmarks launch plugins tests

# Without compiled files each of the tests' many processes would compile everything anew.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: setup demo test interop interop-lerobot lint check format build docs typings weights weights-markers maze-policy maze-wrench-policy pick-place-policy pose-estimator fragile-carry clean

setup: $(READY)
	@echo "touchgoal is ready: $(BIN)/touchgoal --help"

demo: $(READY)
	$(BIN)/touchgoal doctor --quiet
	$(BIN)/touchgoal demo

# What runs in real time needs a core to itself, so it comes after the rest.
test: $(READY)
	$(BIN)/python -m pytest -n auto --dist worksteal -m "not realtime" --durations 20
	$(BIN)/python -m pytest -m realtime --durations 10

# Our driver on controllers that are not ours, in an environment of their own: franka-sim, which wants an older
# mujoco, and franky-sim.
interop: $(READY)
	$(PYTHON) -m venv .venv-interop
	.venv-interop/bin/pip install -q numpy franky-sim==1.0.4 "mujoco<3.3" trimesh
	.venv-interop/bin/pip install -q --no-deps franka-sim==1.1.7
	$(BIN)/python tests/interop/emulators.py

# Sets both ways between touchgoal and lerobot, and our policy in lerobot-eval; lerobot runs in an environment
# of its own, under its own pins.
PYTHON312 ?= $(lastword python3.12 $(wildcard ~/.pyenv/versions/3.12.*/bin/python3.12))
interop-lerobot: $(READY)
	$(PYTHON312) -m venv .venv-lerobot
	.venv-lerobot/bin/pip install -q "lerobot[dataset,diffusion]==0.6.1"
	$(BIN)/python tests/interop/lerobot_run.py .venv-lerobot/bin/python
	.venv-lerobot/bin/pip install -q -e ".[towers,franka]"
	$(BIN)/python tests/interop/lerobot_plugins.py .venv-lerobot/bin/python

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

# The pages of docs/ with the API reference, as a site in runs/site.
docs: $(READY)
	$(BIN)/pip install -q --disable-pip-version-check -c constraints.txt -e '.[docs]'
	$(BIN)/sphinx-build -W --keep-going -q docs runs/site

# How the shipped touch encoder was made: about 45 minutes on 2 cores. Words come from the wand's objects and
# from those of pick-and-place; the normalizer and the value of rewards from successes with ten of them.
REWARD_OBJECTS := glass_ball yarn_ball wooden_block cushion soda_can rope_coil candle corn_cob pebble rag_bundle
weights: $(READY)
	$(BIN)/touchgoal collect-touches --out runs/wand
	$(BIN)/touchgoal collect-demos --env.cameras --episodes 160 --seed 0 --out runs/weights/grasps
	$(BIN)/touchgoal collect-demos --env.objects $(REWARD_OBJECTS) --episodes 40 --seed 3900000 --out runs/weights/successes
	$(BIN)/touchgoal train-encoder surfaces --out runs/surfaces
	$(BIN)/touchgoal train-encoder words --data runs/wand/episodes runs/weights/grasps/episodes \
		--encoder runs/surfaces/encoder --out runs/words
	$(BIN)/touchgoal fit-normalizer runs/weights/successes/episodes --encoder runs/words/encoder \
		--modalities image tactile text --value --out runs/weights/fit
	cp runs/words/encoder/* runs/weights/fit/normalizer.json runs/weights/fit/value.* encoders/weights/gelsight_mini/

# The aligned encoder of the Mini with markers: about 25 minutes.
MARKERS := --env.sensor gelsight_mini_markers
weights-markers: $(READY)
	$(BIN)/touchgoal collect-demos $(MARKERS) --episodes 80 --seed 100000 --out runs/markers/val
	$(BIN)/touchgoal collect-demos $(MARKERS) --episodes 240 --seed 0 --out runs/markers/train
	$(BIN)/touchgoal train-encoder align --data runs/markers/train/episodes \
		--validation runs/markers/val/episodes --normalizer-episodes 60 --out runs/markers/run
	cp runs/markers/run/encoder/* encoders/weights/gelsight_mini_markers/

# How a shipped policy is made anew, by one command each that says what it did (recipe.json beside the
# weights). The maze's baseline learns the touch encoder that both read. (What ships of pick-and-place had
# other rounds, see docs/training.md.)
pose-estimator: $(READY)
	$(BIN)/touchgoal train-pose-estimator --out runs/pose
	cp runs/pose/estimator/* policies/weights/pick_place/estimator/

# The task where touch decides: one policy for each choice of inputs, on the same demonstrations.
FRAGILE := collect-demos --task fragile-carry --env.cameras front wrist
CARRY := train-policy --data runs/fragile/train/episodes --validation runs/fragile/val/episodes --trials 0 \
	--representation base_twist --position-noise 0 --arm-state commanded --observation-horizon 4 --head regression \
	--train.lr 1e-3 --train.epochs 20
TOUCH := --encoder gelsight_mini_markers_mae --touch-input embedding
fragile-carry: $(READY)
	$(BIN)/touchgoal $(FRAGILE) --episodes 20 --seed 100000 --out runs/fragile/val
	$(BIN)/touchgoal $(FRAGILE) --episodes 151 --out runs/fragile/train
	$(BIN)/touchgoal $(CARRY) $(TOUCH) --out runs/fragile/touch
	$(BIN)/touchgoal $(CARRY) --cameras front wrist --out runs/fragile/sight
	$(BIN)/touchgoal $(CARRY) --out runs/fragile/state
	$(BIN)/touchgoal $(CARRY) --hand-force --out runs/fragile/force
	$(BIN)/touchgoal $(CARRY) $(TOUCH) --cameras front wrist --out runs/fragile/both
	$(BIN)/python -m benchmarks fragile-carry \
		--policies $(foreach inputs,touch both sight force state,runs/fragile/$(inputs)/policy)

pick-place-policy: $(READY)
	$(BIN)/touchgoal make-policy --out runs/pick_place
	rm -rf policies/weights/pick_place && cp -r runs/pick_place/policy/policy policies/weights/pick_place

maze-policy: $(READY)
	$(BIN)/touchgoal make-policy --task bead-maze --out runs/maze
	rm -rf policies/weights/bead_maze && cp -r runs/maze/policy/policy policies/weights/bead_maze
	rm -r policies/weights/bead_maze/touch

maze-wrench-policy: $(READY)
	$(BIN)/touchgoal make-policy --task bead-maze --wrench --learn-touch --out runs/maze_wrench
	rm -rf policies/weights/bead_maze_wrench
	cp -r runs/maze_wrench/policy/policy policies/weights/bead_maze_wrench
	mv policies/weights/bead_maze_wrench/touch/* encoders/weights/gelsight_mini_markers_mae/
	rmdir policies/weights/bead_maze_wrench/touch

$(READY): pyproject.toml constraints.txt
	@echo "setting up $(VENV): about 1 GB from PyPI, 2 to 3 minutes"
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --disable-pip-version-check -c constraints.txt -e '.[towers,franka,dev]'
	touch $@

clean:
	rm -rf $(VENV) .venv-wheel dist build typings .pytest_cache .ruff_cache
