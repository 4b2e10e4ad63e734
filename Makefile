# Everything happens in .venv inside this checkout; the logic lives in Python.
PYTHON ?= python3
RUN := .venv/bin/python

.PHONY: setup demo docs test hard-cases mutants clean

# EXTRAS="train view" also installs these extras of pyproject.toml.
setup:
	@$(PYTHON) tools/setup_env.py $(EXTRAS)

demo:
	@$(PYTHON) tools/setup_env.py eval mesh
	@$(RUN) -m benchmarks.demo

# The documentation site; its notebooks are executed, and warnings are errors.
docs:
	@$(PYTHON) tools/setup_env.py docs
	@$(RUN) -m sphinx -W --keep-going -q -b html docs out/docs
	@echo out/docs/index.html

# Two workers: tracing in Python is serial, and Dr.Jit's own threads fill what is left.
test:
	@$(PYTHON) tools/setup_env.py dev
	@$(RUN) -m ruff check .
	@$(RUN) -m mypy mi_ntf
	@$(RUN) -m pytest -n 2 --dist loadfile -q -m "not slow and not gpu"

# Every slow test, and the whole catalogue of hard cases as a table, with 200 random scenes in one process and 60 beside
# volpath among them.
hard-cases:
	@$(PYTHON) tools/setup_env.py dev
	@$(RUN) -m pytest -n 2 --dist loadfile -q -m "slow and not gpu" --ignore tests/hard_cases
	@$(RUN) -m pytest -n 2 --dist loadfile -q tests/hard_cases --catalogue

# Single expressions changed at random, one at a time: which of them the quick tests notice. COUNT=60 takes an hour.
SEED ?= 42
COUNT ?= 60
mutants:
	@$(PYTHON) tools/setup_env.py dev
	@$(RUN) tools/mutants.py --seed $(SEED) --count $(COUNT)

clean:
	rm -rf .venv build dist out .pytest_cache .ruff_cache .mypy_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
