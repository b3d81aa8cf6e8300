# Dwell: one command for each thing. `make help` lists them.

VENV := .venv
BIN := $(VENV)/bin
UV := $(BIN)/uv
# The folders that hold Python.
CODE := conftest.py $(shell find src lab tests examples benchmarks docs reproduction -name '*.py' 2>/dev/null | cut -d/ -f1 | sort -u)

# Where Python keeps what it has compiled, a process begins in half the time.
unexport PYTHONDONTWRITEBYTECODE

# The compiled kernel, and what it is made of.
KERNEL := src/dwell/kernels/libdwell_kernel.so
SOURCES := $(wildcard $(addprefix src/dwell/kernels/,*.cpp *.h compile_flags.txt library_file.py))

# uv installs exactly what a lock file says; `sync` also removes what it does not say.
SYNC := $(UV) pip sync --quiet --python $(BIN)/python --require-hashes
COMPILE := $(UV) pip compile --quiet --python $(BIN)/python --universal --python-version 3.11 \
	--generate-hashes --custom-compile-command "make lock" $(if $(UPGRADE),--upgrade)

.DEFAULT_GOAL := help
.PHONY: help env demo docs test test-sim test-live test-lab test-all tests check lint types tidy collected bench paper planted faults seeds chaos soak fuzz audit release-check sbom lock clean again

help: ## Show this list
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "make %-13s %s\n", $$1, $$2}' Makefile

env: $(VENV)/.installed ## Make .venv from the lock files (only when they changed)

# PYTHON names the interpreter; without it, the first of these that is 3.11 or newer is taken.
$(VENV)/.uv: requirements/uv.txt
	@for python in $(or $(PYTHON),python3 python3.11 python3.12 python3.13 python3.14); do \
		if $$python -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; then \
			echo "make env: $(VENV) from $$($$python --version)"; \
			exec $$python -m venv --clear $(VENV); \
		fi; \
	done; \
	echo "make env: needs Python 3.11 or newer; name one with PYTHON=..." >&2; exit 1
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes \
		-r requirements/uv.txt
	@touch $@

# A machine without a C++20 compiler gets one for the kernel.
$(VENV)/.pinned: $(VENV)/.uv requirements/dev.txt requirements/zig.txt
	@echo "make env: installing the packages of requirements/dev.txt (about a minute)"
	@$(SYNC) requirements/dev.txt
	@$(BIN)/python hatch_build.py 2>/dev/null || $(UV) pip install --quiet --python $(BIN)/python \
		--require-hashes -r requirements/zig.txt || true
	@touch $@

# Compiles the kernel; where that is not possible, says so, and tries again the next time. A short
# run has Python compile the modules that runs need.
$(VENV)/.installed: $(VENV)/.pinned pyproject.toml lab/pyproject.toml hatch_build.py $(SOURCES) $(if $(wildcard $(KERNEL)),,again)
	@echo "make env: compiling the kernel and installing Dwell (5 to 60 s)"
	@$(UV) pip install --quiet --python $(BIN)/python --no-build-isolation --no-deps --editable . --editable lab
	@$(UV) pip check --quiet --python $(BIN)/python
	@test -f $(KERNEL) || $(BIN)/python hatch_build.py || true
	@echo "make env: compiling Python modules with a short run"
	@$(BIN)/python -m dwell run examples/canonical.yaml --windows 20 \
		--out build/first-run --force >/dev/null 2>&1 || true
	@git config core.hooksPath .githooks 2>/dev/null || true
	@echo "make env: done; activate with . $(VENV)/bin/activate"
	@touch $@

demo: env ## Simulate and report an example into demo-out/ (REAL=path: on a real trace)
	$(BIN)/python -m dwell demo $(if $(REAL),--real $(REAL))

TESTS := $(BIN)/python -m pytest
BESIDE := -n auto --no-loadscope-reorder
# Runs all tests that the marks in $(1) leave. Real processes that keep a period run next to the
# others, which have a lower priority; tests that need the machine to themselves follow. Each part
# keeps its failures in a folder of its own, so that none overwrites those of another.
# pytest ends with 5 where ARGS leave nothing to run. What a terminal interrupts is not sent to the
# first part, which has a session of its own (conftest.py).
define run_tests
	@mkdir -p build; ok() { "$$@" || [ $$? -eq 5 ]; }; \
	(exec $(TESTS) -o cache_dir=.pytest_cache/with_priority -m "$(1)with_priority" $(ARGS)) \
		>build/with_priority.txt 2>&1 & prior=$$!; \
	trap "kill -INT $$prior; wait; exit 130" INT TERM HUP; \
	ok nice -n 10 $(TESTS) $(BESIDE) -m "$(1)not alone and not with_priority" $(ARGS); beside=$$?; \
	ok wait $$prior; prior=$$?; trap - INT TERM HUP; cat build/with_priority.txt; \
	ok $(TESTS) -o cache_dir=.pytest_cache/alone -m "$(1)alone" $(ARGS); alone=$$?; \
	[ "$$beside $$prior $$alone" = "0 0 0" ]
endef
# Tests of a flat that any machine runs in minutes.
QUICK := not exhaustive and not alone and not with_priority
# Folders of tests, by flat.
SIMULATOR := cellfile control estimators kernels model policies record reference regression report sim study
LIVE := calibration dash live

test: env ## Run the tests (ARGS="-k name" passes options to pytest, "--hypothesis-profile night" tries more)
	$(call run_tests,not exhaustive and )

test-sim: env ## Run the tests of the simulator, without those of commands
	$(TESTS) $(BESIDE) -m "$(QUICK)" $(addprefix tests/,$(SIMULATOR)) $(ARGS)

test-live: env ## Run the tests of the live runtime, its page and `dwell profile`
	$(TESTS) $(BESIDE) -m "$(QUICK)" $(addprefix tests/,$(LIVE)) $(ARGS)

test-lab: env ## Run the tests of the laboratory
	$(TESTS) $(BESIDE) -m "$(QUICK)" lab/tests $(ARGS)

test-all: env ## Run the tests that `make test` leaves out (conftest.py)
	$(call run_tests,exhaustive and )

tests: env ## Run `make test` and `make test-all` in one, as .ci/run does
	$(call run_tests,)

# Side by side. clang-tidy reads the headers of the system's own C++ library.
check: env ## Lint, formatting, types, the borders between packages and lines of code
	@$(MAKE) --no-print-directory --jobs --output-sync tidy types collected lint

lint:
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports --no-logo
	$(BIN)/python -m tests.plain_english
	$(BIN)/python -m tests.code_lines
	$(BIN)/clang-format --dry-run -Werror $(filter %.cpp %.h,$(SOURCES)) tests/kernels/*.cpp

types:
	$(BIN)/mypy $(CODE) hatch_build.py

tidy:
	$(BIN)/clang-tidy --quiet $(filter %.cpp,$(SOURCES))

# pytest compiles each file of tests here, and not once per process of `make test`.
collected:
	@mkdir -p build
	@$(TESTS) --collect-only -qq >build/collected.txt || (cat build/collected.txt; exit 1)

docs: $(VENV)/tools/site ## Make the site from the pages into build/site (strict)
	PYTHONPATH=$< $(BIN)/python -m docs.site

bench: env ## Run the benchmarks
	$(BIN)/python -m benchmarks $(ARGS)

paper: env ## Ask the paper's questions; hours (ARGS="--scale quick": minutes; --help)
	$(BIN)/python -m reproduction $(ARGS)

planted: env ## Plant faults in copies of the tree; each must be found (ARGS="--only NAME -n 4")
	$(BIN)/python -m tests.planted $(ARGS)

faults: env ## Kill, freeze and cut real processes, 60 times each way; goes on where it was stopped
	$(BIN)/python -m tests.live.faults $(ARGS)

chaos: env ## Half an hour of chaos on a real cell, judged from the wire (ARGS="--minutes 2 --seed 7")
	$(BIN)/python -m dwell testbed chaos --minutes 30 --faults 1000 $(ARGS)

seeds: env ## 1,000 faults by seed on cells in memory; goes on where it was stopped (ARGS="--faults 100000")
	$(BIN)/python -m tests.live.seeded_faults --faults 1000 $(ARGS)

soak: env ## An hour of a real cell at 25 Hz: memory, files, threads (ARGS="--minutes 10")
	$(BIN)/python -m tests.live.soak $(ARGS)

# Tools that are no part of the environment; each gets a folder of its own.
$(VENV)/tools/%: requirements/%.txt $(VENV)/.installed
	@rm -rf $@
	$(UV) pip install --quiet --python $(BIN)/python --require-hashes --target $@ -r $<
	@touch $@

fuzz: $(VENV)/tools/fuzz ## Fuzz what reads from the network, guided by coverage (ARGS="--seconds 600")
	PYTHONPATH=$< $(BIN)/python -m tests.fuzz $(ARGS)

audit: $(VENV)/tools/release ## Look up known vulnerabilities of all that is pinned (needs a package index that knows them)
	@for file in runtime dev; do \
		PYTHONPATH=$< $(BIN)/python -m pip_audit --strict --disable-pip --require-hashes \
			-r requirements/$$file.txt || exit 1; \
	done

release-check: $(VENV)/tools/release ## Build wheels and try them in each Python, and README as a stranger (minutes)
	PYTHONPATH=$< $(BIN)/python -m tests.release_check $(ARGS)

sbom: $(VENV)/tools/release ## Write what is pinned to dist/sbom.json (CycloneDX)
	@mkdir -p dist
	PYTHONPATH=$< $(BIN)/python -m cyclonedx_py requirements --pyproject pyproject.toml \
		--output-reproducible --output-format JSON --output-file dist/sbom.json requirements/dev.txt

lock: $(VENV)/.uv ## Pin the dependencies of pyproject.toml again (UPGRADE=1: to the newest)
	$(COMPILE) --group uv --output-file requirements/uv.txt
	$(COMPILE) pyproject.toml --extra report --extra sim --output-file requirements/runtime.txt
	$(COMPILE) pyproject.toml lab/pyproject.toml --all-extras --group pyproject.toml:dev \
		--no-emit-package dwell-placement --constraint requirements/runtime.txt \
		--output-file requirements/dev.txt
	$(COMPILE) --group fuzz --output-file requirements/fuzz.txt
	$(COMPILE) --group release --output-file requirements/release.txt
	$(COMPILE) --group site --output-file requirements/site.txt
	$(COMPILE) --group zig --output-file requirements/zig.txt
	@! grep -nE '://|^ *--(index|extra-index|find-links|trusted-host)' requirements/*.txt

clean: ## Remove everything that make made
	rm -rf $(VENV) $(KERNEL) build dist demo-out fuzz-corpus .mypy_cache .pytest_cache .ruff_cache .import_linter_cache .hypothesis
	find $(CODE) -name __pycache__ -prune -exec rm -rf {} +
