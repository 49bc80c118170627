# `make demo` and `make test` do all set-up on a fresh machine with Python 3.11.
PYTHON ?= $(shell command -v python3.11 || command -v python3)
VENV ?= .venv
BIN := $(VENV)/bin
# Tests start hundreds of processes, which would each compile all modules where writing them compiled is turned off.
export PYTHONDONTWRITEBYTECODE =

.PHONY: demo test test-slow test-crash test-all lint format bench train-all clean

demo: $(VENV)/.installed
	$(BIN)/rlctl train reach
	$(BIN)/rlctl eval reach --min-success 0.95
	$(BIN)/rlctl export reach --onnx
	$(BIN)/rlctl replay reach

# Lint and types are checked beside the tests; what they say comes after the tests' own lines.
test: $(VENV)/.dev
	@said=$$(mktemp); $(MAKE) --no-print-directory lint > $$said 2>&1 & lint=$$!; \
	trap 'kill $$lint 2> /dev/null; rm -f $$said' EXIT; \
	$(BIN)/python -m pytest -n 3 --dist worksteal; tests=$$?; \
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

bench: $(VENV)/.dev
	$(BIN)/python -m tests.benchmarks

# Trains what is missing of every bundled task, and writes the tables of scores; hours. SEEDS=1-3 by default.
train-all: $(VENV)/.dev
	$(BIN)/python -m tests.benchmarks.train_all $(if $(SEEDS),--seeds $(SEEDS))

clean:
	rm -rf $(VENV) dist build .mypy_cache .ruff_cache .pytest_cache

$(VENV)/.installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install -q -c constraints.txt -e .
	touch $@

$(VENV)/.dev: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install -q -c constraints.txt -e '.[dev]'
	touch $(VENV)/.installed $@
