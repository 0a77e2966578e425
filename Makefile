# make demo: the main job on the embedded real data.   make test: the tests.   make bench: the quick benchmarks' ratios.
# make results: judges the shipped bundles, writes docs/results.md.   make stability: the extremes (an hour or two), docs/stability.md.
# All set up .venv first.
# A plain Python package index serves torch's CUDA build for Linux (several GB). For the small CPU build:
#   make demo TORCH_INDEX="--index-url https://download.pytorch.org/whl/cpu"
PYTHON ?= python3
TORCH_INDEX ?=
BIN = .venv/bin

.PHONY: setup demo test bench results stability

setup: .venv/.setup-done

.venv/.setup-done: pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "Python >= 3.11 is needed; $(PYTHON) is older. Try make PYTHON=python3.12 ..."; exit 1; }
	@$(PYTHON) -c 'import ensurepip' 2>/dev/null || { echo "Python's venv module is missing: apt-get install python3-venv"; exit 1; }
	$(PYTHON) -m venv .venv
	$(BIN)/pip install -q --disable-pip-version-check $(TORCH_INDEX) "$$(grep '^torch==' constraints.txt)"
	$(BIN)/pip install -q --disable-pip-version-check -c constraints.txt -e '.[dev]'
	@touch $@

demo: setup
	$(BIN)/python train.py experiment=hopper

test: setup
	$(BIN)/ruff check -q .
	$(BIN)/ruff format -q --check .
	$(BIN)/mypy -p gns_pyg -p data_gen -p benchmarks
	$(BIN)/python -m pytest -n auto --maxprocesses 4 --dist loadfile

results: setup
	OMP_NUM_THREADS=1 $(BIN)/python -m gns_pyg.results

stability: setup
	for b in hopper drum inclined_drum; do OMP_NUM_THREADS=1 $(BIN)/python stress.py bundle=$$b hydra.run.dir=runs/stability/$$b || exit 1; done
	$(BIN)/python -m gns_pyg.stability runs/stability docs

bench: setup
	OMP_NUM_THREADS=1 $(BIN)/python -m benchmarks
