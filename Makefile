# The checks of a change. Tools are taken from .venv where there is one: make check, or make check BIN=/path/to/bin/
BIN ?= $(if $(wildcard .venv/bin/python),.venv/bin/)
SUITE ?= quick

.PHONY: help check format test slow bench

help:  ## this list
	@sed -nE 's/^([a-z]+):.*## (.*)/\1\t\2/p' Makefile

check:  ## style, types and layers, in seconds
	$(BIN)ruff check .
	$(BIN)ruff format --check .
	$(BIN)mypy
	$(BIN)lint-imports

format:  ## lay out the code, and mend what ruff can mend
	$(BIN)ruff check --fix .
	$(BIN)ruff format .

test:  ## the tests; TESTS="tests/kernels -k grid" for some of them
	$(BIN)pytest $(TESTS)

slow:  ## whole sequences, minutes each
	$(BIN)pytest -m slow $(TESTS)

bench:  ## the paper's studies on small rendered rooms; SUITE=FILE for others
	$(BIN)warpslam bench $(SUITE)
