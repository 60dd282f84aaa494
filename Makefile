# Two commands matter: `make demo` and `make test`. Each sets up everything it needs in .venv.
PYTHON ?= python3
OUT ?= out
JSON ?= $(OUT)/live-map.json
VENV := .venv
BIN := $(VENV)/bin
ARGS ?=
WORKERS ?= 3

# Whatever the environment says: each service and simulator that a test starts would compile hundreds of files again.
export PYTHONDONTWRITEBYTECODE =

.PHONY: demo test test-long faults fuzz lint bench clean
.DELETE_ON_ERROR:

$(VENV)/installed: pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(0 if sys.version_info >= (3, 11) else "Python 3.11 or newer is needed; set PYTHON=/path/to/python3")'
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[simulation]'
	@touch $@

$(VENV)/installed-dev: $(VENV)/installed
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[dev]'
	-$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps 'printrun==2.2.0'  # its core, without wx
	@touch $@

demo: $(VENV)/installed
	$(BIN)/scanner demo --out $(OUT) $(ARGS)

test: $(VENV)/installed-dev
	$(BIN)/python -m pytest -n $(WORKERS) --dist loadfile --no-loadscope-reorder $(ARGS)

# Emulators that others wrote, in an environment of their own: OctoPrint (AGPL) is a tool of the tests, never imported.
$(VENV)/emulators: $(VENV)/installed
	-$(PYTHON) -m venv $(VENV)/octoprint && $(VENV)/octoprint/bin/python -m pip install --quiet --disable-pip-version-check 'octoprint==1.11.8'
	@touch $@

test-long: $(VENV)/installed-dev $(VENV)/emulators
	$(BIN)/python -m pytest -m long --timeout 3600 $(ARGS)

# Coverage-guided, one parser after the other; what it finds interesting stays in tests/fuzz/corpus.
FUZZ_S ?= 60
FUZZ ?= native scip lms lms_requests ls100 rplidar rplidar_samples rplidar_capsules rplidar_ultra
fuzz: $(VENV)/installed-dev
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[fuzz]'
	for target in $(FUZZ); do $(BIN)/python -m tests.fuzz $$target -max_total_time=$(FUZZ_S) -max_len=2048 $(ARGS) || exit 1; done

# The release draws of the fault harness, some hours; ARGS="cuts --cuts 1000" makes one of them, smaller.
faults: $(VENV)/installed-dev
ifdef ARGS
	$(BIN)/python -m tests.faults $(ARGS)
else
	$(BIN)/python -m tests.faults cuts
	$(BIN)/python -m tests.faults faults
	$(BIN)/python -m tests.faults flips
	$(BIN)/python -m tests.faults kills
endif

# Open3D is large, and wanted here only; JSON=FILE chooses where the figures go.
bench: $(VENV)/installed
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[bench]'
	$(BIN)/scanner bench live-map --json $(JSON) $(ARGS)

lint: $(VENV)/installed-dev
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports

clean:
	rm -rf $(VENV) out .mypy_cache .ruff_cache .pytest_cache
