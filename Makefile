# `make demo` and `make test` do all set-up on a fresh machine, with a Python from 3.11 to 3.14, or with uv, which
# downloads 3.11: PyBullet has no wheels above. With the others MuJoCo simulates.
PYTHONS := python3.11 python3.14 python3.13 python3.12
PYTHON ?= $(shell for python in $(PYTHONS); do \
	$$python -c 'import sys; print(sys.executable)' 2> /dev/null && break; done)
# `make demo TORCH_INDEX=ADDRESS` takes PyTorch from the index that its installation page names for the CPU, which saves
# gigabytes of CUDA where pip's default build has it.
TORCH_INDEX ?=
VENV ?= .venv
BIN := $(VENV)/bin
# uv installs in parallel. Modules are compiled when they are first imported: most are never used.
INSTALL ?= $(if $(shell command -v uv),uv pip install --quiet --python $(BIN)/python,$(BIN)/pip install -q --no-compile)
# Tests start hundreds of processes, which would each compile all modules where writing them compiled is turned off.
export PYTHONDONTWRITEBYTECODE =

.PHONY: demo test test-slow test-crash test-all lint format docs bench compare train-all clean

demo: $(VENV)/.installed
	$(BIN)/rlctl demo

# Lint and types are checked beside the tests; what they say comes after the tests' own lines.
test: $(VENV)/.dev
	@said=$$(mktemp); $(MAKE) --no-print-directory lint > $$said 2>&1 & lint=$$!; \
	trap 'kill $$lint 2> /dev/null; rm -f $$said' EXIT; \
	$(BIN)/python -m pytest -n logical --maxprocesses 4 --dist worksteal --durations 40 --durations-min 1; tests=$$?; \
	wait $$lint; code=$$?; cat $$said; \
	[ $$tests -eq 0 ] && [ $$code -eq 0 ]

test-slow: $(VENV)/.dev
	$(BIN)/python -m pytest -m slow --timeout 3600

test-crash: $(VENV)/.dev
	$(BIN)/python -m pytest tests/crash -m "" -n 2 --dist worksteal --timeout 3600

test-all: lint
	$(BIN)/python -m pytest -m "" -n 2 --dist worksteal --timeout 3600

lint: $(VENV)/.dev
	$(BIN)/ruff format --check
	$(BIN)/ruff check
	$(BIN)/mypy

format: $(VENV)/.dev
	$(BIN)/ruff check --fix
	$(BIN)/ruff format

docs: $(VENV)/.docs
	$(BIN)/python docs/make_site.py
	$(BIN)/python -m zensical build --strict --clean
	@echo "open build/site/index.html; for the search: $(BIN)/python -m http.server -d build/site"

bench: $(VENV)/.dev
	$(BIN)/python -m tests.benchmarks

# Trains every classic and reach with rlctl, rl-zoo3 and sbx; hours. RLCTL_ZOO and RLCTL_SBX name their Pythons.
compare: $(VENV)/.dev
	$(BIN)/python -m tests.benchmarks.compare $(TASKS)

# Trains what is missing of every bundled task, and writes the tables of scores; hours. SEEDS=1-3 by default.
train-all: $(VENV)/.dev
	$(BIN)/python -m tests.benchmarks.train_all $(if $(SEEDS),--seeds $(SEEDS))

clean:
	rm -rf $(VENV) dist build .mypy_cache .ruff_cache .pytest_cache

$(BIN)/python:
	@if [ -n "$(PYTHON)" ]; then \
		$(PYTHON) -c 'import sys; sys.exit(sys.version_info[:2] > (3, 11))' || \
			echo "PyBullet has no wheels for Python 3.12 and newer: tasks are simulated in MuJoCo. For those that need" \
				"PyBullet use Python 3.11, or build PyBullet afterwards (CONTRIBUTING.md)"; \
		$(PYTHON) -m venv $(VENV); \
	elif command -v uv > /dev/null; then \
		uv venv --quiet --seed --python 3.11 $(VENV); \
	else \
		echo "no Python from 3.11 to 3.14 found: install one, or uv (https://docs.astral.sh/uv), and run make again"; exit 1; \
	fi
	@echo "installing into $(VENV): up to 2.2 GB, of which PyTorch for the CPU 0.7, Rerun 0.7, PyBullet 0.3 and SciPy 0.1 GB"
	@if [ -n "$(TORCH_INDEX)" ]; then $(INSTALL) --no-deps -c constraints.txt --index-url "$(TORCH_INDEX)" torch; fi

$(VENV)/.installed: pyproject.toml constraints.txt | $(BIN)/python
	$(INSTALL) -c constraints.txt -e .
	touch $@

$(VENV)/.dev: pyproject.toml constraints.txt | $(BIN)/python
	$(INSTALL) -c constraints.txt -e '.[dev]'
	touch $(VENV)/.installed $@

$(VENV)/.docs: pyproject.toml constraints.txt | $(BIN)/python
	$(INSTALL) -c constraints.txt -e '.[docs]'
	touch $(VENV)/.installed $@
