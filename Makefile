# Every target is complete on a fresh machine with Python >= 3.11 and make; all share .venv.
PYTHON ?= python3
BIN := .venv/bin
VENV := .venv/.made
RUNTIME := .venv/.runtime
TESTING := .venv/.testing
CHECKING := .venv/.checking
DOCUMENTING := .venv/.documenting
MUTATING := .venv/.mutating
RELEASING := .venv/.releasing
BENCHING := .venv/.benching

.PHONY: run test thorough refine bench blind blind-fmu bundles baseline corpus crash kills fuzz mutants seed check docs dist trial versions clean fmus
N ?= 24
CRASHES ?= 200
KILLS ?= 200
EXAMPLES ?= 10000
SEEDS ?= 200
.DEFAULT_GOAL := run
.NOTPARALLEL: # all share .venv

PIP := $(BIN)/python -m pip --disable-pip-version-check -qq

# $(call install,PACKAGES): compiles on all cores, and not the tests of packages, half of what pip would compile;
# templates of packages do not compile
define install
$(PIP) install --no-compile $(1)
@$(BIN)/python -m compileall -qq -j 0 -x '/tests/' .venv/lib cosim controller fmus plant || true
@touch $@
endef

$(VENV):
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "Python 3.11 or newer is needed")'
	$(PYTHON) -m venv .venv
	$(PIP) install --upgrade pip # the one of Python 3.11 chooses from long lists of wheels at half the speed
	$(PIP) uninstall --yes cosim-hovercraft # of an earlier release: one distribution for all
	@touch $@

$(RUNTIME): $(VENV) pyproject.toml examples/hovercraft/pyproject.toml
	$(call install,--editable . --editable examples/hovercraft)

# all in one go if this is the first
$(TESTING): $(VENV) pyproject.toml examples/hovercraft/pyproject.toml
	$(call install,--editable '.[test]' --editable examples/hovercraft)
	@touch $(RUNTIME)

$(CHECKING): $(TESTING)
	$(call install,--editable '.[check]')

$(MUTATING): $(TESTING)
	$(call install,--editable '.[mutants]')

$(DOCUMENTING): $(TESTING) # known answers are tables of the tests
	$(call install,--editable '.[docs]')

$(RELEASING): $(RUNTIME)
	$(call install,--editable '.[release]')

$(BENCHING): $(RUNTIME)
	$(call install,--editable '.[sweep,bench]')

fmus: $(RUNTIME)
	$(BIN)/cosim build --model hovercraft --design examples/hovercraft/design.yaml --out build

run: fmus
	$(BIN)/cosim run scenarios/manoeuvre.yaml

test: $(TESTING)
	$(BIN)/python -m pytest -n 3 --dist loadscope --no-loadscope-reorder -m "not thorough"

# the tests that take longest, as `make test` has shorter ones of the same
thorough: $(TESTING)
	$(BIN)/python -m pytest -n 2 --dist loadscope --no-loadscope-reorder -m thorough

refine: $(RUNTIME)
	$(BIN)/cosim refine examples/hovercraft/study.yaml

blind: $(TESTING)
	$(BIN)/python -m tests.blind.harness $(N)

blind-fmu: $(TESTING)
	$(BIN)/python -m tests.blind.harness $(N) --half fmu

# decision bundles of STUDIES (SUITE:FIRST:COUNT …), as far as they are missing; without, the table of alternatives
bundles: $(TESTING)
	$(BIN)/python -m tests.blind.bundles $(STUDIES)

# the frozen blind studies at the revision in tests/corpus/revision, as far as they are missing
baseline: $(TESTING)
	$(BIN)/python -m tests.blind.baseline

# the same commands with the wheels of REV (that of tests/corpus/revision) and of this tree; ONLY a pattern of desks
corpus: $(TESTING)
	$(BIN)/python -m tests.corpus $(if $(REV),--rev $(REV)) $(if $(ONLY),--only '$(ONLY)')

crash: $(TESTING)
	$(BIN)/python -m tests.crash $(CRASHES)

kills: $(TESTING)
	$(BIN)/python -m tests.kills $(KILLS)

# EXAMPLES in all; SEED of an earlier run finds the same again
fuzz: $(TESTING)
	$(BIN)/python -m tests.fuzz $(EXAMPLES) $(SEED)

# the 200 faults of tests/mutants_frozen.jsonl, each tried against the tests of its subject, as far as they are missing
# for these sources
mutants: $(MUTATING)
	$(BIN)/python -m tests.mutants

# how often the intervals of `cosim identify` hold the truth, over SEEDS; the controllers, over 20
seed: $(TESTING)
	$(BIN)/python -m tests.seed $(SEEDS)
	$(BIN)/python -m tests.controllers 20

# ratios of docs/performance.md
bench: $(BENCHING)
	@$(BIN)/python -m benchmarks

check: $(CHECKING)
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	@if command -v npm >/dev/null; then npm install --silent --no-audit --no-fund --no-package-lock && npm run --silent check; \
	else echo "no npm: scripts of pages are not checked"; fi

# the site, docs/_site: reports of the gallery, pages, check of every link; LINKS=--external also links to other sites
docs: $(DOCUMENTING)
	$(BIN)/python docs/site.py $(LINKS)

# wheels and sdists of both distributions
dist: $(RELEASING)
	$(BIN)/python -m release.dist

# the distributions in empty environments: no compiler, no network but a folder of wheels
trial: dist
	$(BIN)/python -m release.trial $(TRIALS)

# a set of wheels for each Python and platform; tests with the Pythons that are here, and with the oldest dependencies
versions: $(RELEASING)
	$(BIN)/python -m release.versions resolve
	$(BIN)/python -m release.versions run
	$(BIN)/python -m release.versions run --oldest

clean:
	rm -rf build results dist docs/_made docs/_site docs/_site.doctrees .pytest_cache .mypy_cache .ruff_cache .hypothesis .import_linter_cache *.egg-info
