# `make demo` is all a newcomer needs; `make check` is what CI runs.
PYTHON ?= python3
VENV := .venv
export PATH := $(CURDIR)/$(VENV)/bin:$(PATH)
# Nothing but the package index is ever contacted.
export DVC_NO_ANALYTICS := 1
export DO_NOT_TRACK := 1
export PREFECT_SERVER_ANALYTICS_ENABLED := false
export HF_HUB_OFFLINE := 1
export PIP_DISABLE_PIP_VERSION_CHECK := 1

.PHONY: demo install install-dev docs test test-fast test-long chaos fuzz mutation lint types imports check bench clean

demo: $(VENV)/.installed
	hoidata repro

install: $(VENV)/.installed
install-dev: $(VENV)/.installed-dev

# pip compiles packages on one core; compileall uses all. It fails on templates that are not Python: they stay as they are.
PIP_OPTIONS := --quiet --no-compile -c constraints.txt
COMPILE := $(VENV)/bin/python -m compileall -qq -j 0 $(VENV)/lib || true

$(VENV)/.installed: pyproject.toml constraints.txt
	test -x $(VENV)/bin/python || $(PYTHON) -m venv $(VENV)
	$(VENV)/bin/pip install $(PIP_OPTIONS) -e .
	$(COMPILE)
	touch $@

# One call for all packages: two would resolve them twice.
$(VENV)/.installed-dev: pyproject.toml constraints.txt
	test -x $(VENV)/bin/python || $(PYTHON) -m venv $(VENV)
	$(VENV)/bin/pip install $(PIP_OPTIONS) -e '.[test,dev,docs]'
	$(COMPILE)
	touch $(VENV)/.installed $@

# The documentation as a site in build/site; strict: no dead link, nothing left out.
docs: install-dev
	NO_MKDOCS_2_WARNING=1 python -m mkdocs build --strict --quiet

# Three processes: with two, cores wait for servers and killed processes.
test: install-dev
	OMP_NUM_THREADS=1 pytest -n 3 --dist loadscope -m "not long"

test-fast: install-dev
	OMP_NUM_THREADS=1 pytest -n 2 --dist loadscope -m "not slow and not long"

# Whole runs, trainings and corpora, killed processes and servers, most of 5 seconds or more; CI runs them after `make check`.
test-long: install-dev
	OMP_NUM_THREADS=1 pytest -n 3 --dist loadscope -m long

# Every situation that may stop a run, three times each; `make test` has a share of it.
chaos: install-dev
	OMP_NUM_THREADS=1 HOIDATA_CHAOS=3 pytest tests/pipelines/test_chaos.py tests/pipelines/test_interrupts.py tests/hoidata/test_cluster.py

# 50,000 damaged files for each parser, over a million in all; inputs that fail are kept in .fuzz/.
fuzz: install-dev
	OMP_NUM_THREADS=1 python -m fuzz --jobs 2 --executions 50000

# Small changes of the code, each of which a test must notice. Of other packages: make mutation PATHS="hoidata/geometry"
PATHS ?= hoidata/contact hoidata/annotation hoidata/clips
mutation: install-dev
	OMP_NUM_THREADS=1 python -m tests.mutation $(PATHS)

lint: install-dev
	ruff check .
	ruff format --check .
	python -m docs.make.plain_words

types: install-dev
	pyright

imports: install-dev
	lint-imports

check: lint types imports docs test

# Speed next to named baselines of the same run; minutes. One part: python -m bench adapters
bench: install-dev
	OMP_NUM_THREADS=1 python -m bench

# Removes what the graph made and the generated raw data; your own raw files are never touched.
clean:
	rm -rf code data checkpoints evaluators samples metrics report .hoidata
