# Two commands do everything: `make demo` and `make test`.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
# What Python compiles and pytest rewrites is kept for every process after the first.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo test test-fast check format env kernel clean

demo: env ## the main job on Dark Room: ICAA with two workers, one to five minutes
	$(BIN)/icrl-dist train demo --overwrite

test: env ## every test, file by file in three processes: many of them wait
	$(BIN)/python -m pytest -n 3 --dist loadfile --no-loadscope-reorder

test-fast: env ## the tests of one process each, without Ray, Zenoh, browsers and trainings
	$(BIN)/python -m pytest -m unit -n 2 --dist loadfile --no-loadscope-reorder

check: env ## format, lint, types, import contracts
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports

format: env
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

env: $(READY) ## the virtual environment

$(READY): pyproject.toml constraints.txt $(wildcard icrl_dist/models/*.[ch])
	$(PYTHON) -c 'import sys; v = sys.version_info[:2]; sys.exit(0 if v >= (3, 11) else f"icrl-dist needs Python 3.11, this is {v[0]}.{v[1]}: run make PYTHON=python3.11")'
	$(PYTHON) -m venv $(VENV)
	rm -f icrl_dist/models/_*.so
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[dev]'
	touch $(READY)

kernel: env ## the compiled kernels again, for example after a compiler was installed
	rm -f icrl_dist/models/_*.so
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --editable .
	$(BIN)/icrl-dist doctor | grep kernel

clean:
	rm -rf $(VENV) build *.egg-info icrl_dist/models/_*.so
