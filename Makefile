# Everything sets itself up from a bare clone: Python 3.11 or newer, make and a C compiler are needed.
PYTHON ?= python3
VENV ?= .venv
OUT ?= out/bench
STUDY_OUT ?= out
EDGE_OUT ?= out/edge
ROBUSTNESS_OUT ?= out/robustness
MARKET_OUT ?= out/market
PROVE_OUT ?= out/prove
TUNE_OUT ?= out/tune
REPORTS_OUT ?= out/reports
SITE_OUT ?= out/site
LAB_OUT ?= docs/laboratory/index.html
COVERAGE_OUT ?= out/coverage
BILL_OUT ?= out/bill.json
# Which study, and options of it: make study NAME=tracking OPTIONS=--quick
NAME ?=
OPTIONS ?=
# Of make market, prove and tune.
MARKET ?=
PROVE ?=
TUNE ?=
# What is fuzzed: make fuzz FUZZ="long --seed 7", FUZZ="controller --seed 1 --count 500", FUZZ="live --seconds 600"
FUZZ ?= short
GOALS ?=
# Which mutants are tried: make mutants MUTANTS="--seed 7 --count 40 --only mpc/core/*.c"
MUTANTS ?=
# Packages that are tested: make test-packages PACKAGE=monitor
PACKAGE ?= $(notdir $(patsubst %/,%,$(dir $(wildcard packages/*/pyproject.toml))))
# Options of pytest: make test TEST="tests/mpc -x"
TEST ?=
MARKED ?= not system and not long
SYSTEM ?= system and not long
# Lists of packages that stand beside the project's own, pinned with hashes too.
HASHED := --no-config --universal --python-version 3.11 --generate-hashes --no-emit-index-url --no-emit-find-links \
	--no-header --no-annotate --quiet
PEERS_LIST := studies/speed/subjects/requirements
# Packages that build on this one, each with its own pyproject.toml.
PACKAGES := $(wildcard packages/*/.)
BIN := $(VENV)/bin
# What `make bench` needs: the package alone, 50 packages of some 300.
CORE := $(VENV)/.core
# What everything else needs: tests, studies, documents, ROS.
READY := $(VENV)/.ready
# And the C compiler of the laboratory, 400 MB.
LAB_READY := $(VENV)/.lab
PIP_INSTALL := $(BIN)/pip install --quiet --disable-pip-version-check --no-compile
# The lists are whole. An older pip that resolves them again trips over extras of a package with a newer release.
LOCKED := --no-deps --require-hashes -r

# One thread per process: the matrices are small, and runs are spread over the cores as processes.
export OMP_NUM_THREADS = 1
export OPENBLAS_NUM_THREADS = 1

.PHONY: help bench bench-full results edge goals study robustness market prove tune screenshots wheel wheels test test-packages test-system coverage fuzz mutants lab lint types format models calibrate readme schemas site notebooks pictures requirements bill audit clean

help: ## this list
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | sort | awk -F ':.*## ' '{printf "  make %-14s %s\n", $$1, $$2}'

$(CORE): requirements-bench.txt pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit("Python 3.11 or newer is needed, this is %d.%d; try: make PYTHON=python3.12 ..." % sys.version_info[:2] if sys.version_info < (3, 11) else 0)'
	$(PYTHON) -m venv $(VENV)
	$(PIP_INSTALL) $(LOCKED) requirements-bench.txt
	$(PIP_INSTALL) --no-deps --no-build-isolation --editable .
	@touch $(CORE)

# Of the long list uv, which stands in it, is installed first: it takes a quarter of the time for the others. Where it cannot
# (an index or certificates that only pip was told of), pip installs them too.
$(READY): $(CORE) requirements.txt
	@$(BIN)/python -c 'print("uv==" + open("requirements.txt").read().split("\nuv==")[1].split("\n    #")[0])' >$(VENV)/uv.txt
	$(PIP_INSTALL) $(LOCKED) $(VENV)/uv.txt
	$(BIN)/uv pip install --quiet --no-config --python $(BIN)/python $(LOCKED) requirements.txt || $(PIP_INSTALL) $(LOCKED) requirements.txt
	$(PIP_INSTALL) --no-deps --no-build-isolation $(addprefix --editable ,$(PACKAGES))
	$(BIN)/python -m diffdrive_mpc.app.schemas
	@touch $(READY)

$(LAB_READY): $(READY) .ci/lab.txt
	$(PIP_INSTALL) $(LOCKED) .ci/lab.txt
	@touch $(LAB_READY)

bench: $(CORE) ## every model along every trajectory with five seeds: tables and figures in out/bench
	$(BIN)/diffdrive-mpc bench --out $(OUT)

bench-full: $(CORE) ## the same, and sweeps of speed, dead time and horizon: out/bench
	$(BIN)/diffdrive-mpc bench --sweeps --out $(OUT)

edge: $(READY) ## fast and tight paths, all models beside their peers, path by path: out/edge
	$(BIN)/diffdrive-mpc bench --out $(EDGE_OUT) --controller mpc,pursuit+slip,kanayama+slip,lqr+slip,mppi+slip \
		--models kinematic,mbm,sm,ssm --horizons none --seeds 2 \
		--trajectories fast_circle,figure8,slalom,reverse_slalom,k_turn,spiral,tight,spline-0,spline-1,spline-2

goals: $(READY) ## a hundred random goals of the node's action in a row, over DDS, with memory and threads: some minutes
	$(BIN)/python tests/mpc/follow_long.py --goals 100 $(GOALS)

study: $(READY) ## one study again, make study NAME=tracking: out/tracking; its options in OPTIONS; python -m studies lists them
	$(BIN)/python -m studies $(NAME) --out $(STUDY_OUT)/$(NAME) $(OPTIONS)

robustness: $(READY) ## every controller on other robots, floors, loads and sensors: out/robustness
	$(BIN)/python -m studies robustness --out $(ROBUSTNESS_OUT) --controllers mpc,pursuit+slip,kanayama+slip,lqr+slip \
		--models ssm,sm --trajectories circle,s --seeds 6,7

market: $(READY) ## a thousand robots that nobody tuned to: out/market, some six minutes; MARKET="--rates 1,10,100", other controllers
	$(BIN)/python -m studies robustness --out $(MARKET_OUT) --robots 1000 --controllers mpc $(MARKET)

prove: $(READY) ## how often the controller fails on many plants, paths and faults, and where it stops to hold: out/prove
	$(BIN)/diffdrive-mpc prove ssm --out $(PROVE_OUT) $(PROVE)

tune: $(READY) ## search for a better configuration, and compare with the shipped one on other seeds: out/tune
	$(BIN)/diffdrive-mpc tune ssm --out $(TUNE_OUT) $(TUNE)

screenshots: $(READY) ## reports of small real runs, and their pictures for docs/logs.md, in a real browser
	$(BIN)/diffdrive-mpc simulate --trajectory s --out $(REPORTS_OUT)/simulate --log $(REPORTS_OUT)/s.csv
	$(BIN)/diffdrive-mpc simulate --trajectory square --log $(REPORTS_OUT)/square.csv
	$(BIN)/diffdrive-mpc simulate --trajectory cane --log $(REPORTS_OUT)/cane.csv
	$(BIN)/diffdrive-mpc identify $(REPORTS_OUT)/s.csv $(REPORTS_OUT)/square.csv --validate $(REPORTS_OUT)/cane.csv \
		--structure ssm --out $(REPORTS_OUT)/identify
	$(BIN)/diffdrive-mpc bench --quick --out $(REPORTS_OUT)/bench
	$(BIN)/python -m studies tracking --quick --out $(REPORTS_OUT)/tracking
	$(BIN)/diffdrive-mpc prove ssm --runs 100 --out $(REPORTS_OUT)/prove
	for name in simulate bench identify tracking prove; do \
		$(BIN)/python tests/browser.py $(REPORTS_OUT)/$$name/report.html docs/reports/$$name.png || exit 1; \
	done
	$(BIN)/python tests/browser.py $(REPORTS_OUT)/simulate/report.html docs/reports/phone.png 390 1500

wheel: $(READY) ## a wheel for this machine and a source archive, both in dist/: it needs neither the clone nor a compiler any more
	$(BIN)/uv build --python $(BIN)/python --out-dir dist

wheels: $(READY) ## wheels of root and packages for this kind of machine as a release has them, tried on each Python: dist/; needs Docker
	$(BIN)/uv build --python $(BIN)/python --sdist --out-dir dist
	$(BIN)/cibuildwheel --output-dir dist
	for package in $(patsubst %/setup.py,%,$(wildcard packages/*/setup.py)); do \
		CIBW_BUILD="cp311-manylinux*" CIBW_BUILD_FRONTEND="build[uv]" CIBW_ENVIRONMENT=UV_FIND_LINKS=/project/dist \
			$(BIN)/cibuildwheel --output-dir dist $$package || exit 1; \
	done
	$(BIN)/uv build --python $(BIN)/python --wheel --out-dir dist packages/lab

test: $(READY) ## all tests but those of `make test-system` and of `.ci/long tests`
	$(BIN)/pytest -n 2 --dist worksteal -m "$(MARKED)" $(TEST)

test-packages: $(READY) ## tests of the packages, each on built wheels in an environment of its own; PACKAGE=monitor for one
	VENV=$(VENV) .ci/test_package $(PACKAGE) -- -n 2 --dist worksteal -m "$(MARKED)" $(TEST)

test-system: $(LAB_READY) ## tests of several processes, many drives and documents, and those that need Debian packages: browser, emulator, X server
	$(BIN)/pytest -n 2 --dist worksteal -m "$(SYSTEM)" $(TEST)

coverage: $(READY) ## line coverage of `make test`, as a table and in out/coverage
	$(PIP_INSTALL) $(LOCKED) .ci/coverage.txt
	$(BIN)/pytest -n 2 --dist worksteal -m "$(MARKED)" --cov=diffdrive_mpc --cov-report=term:skip-covered --cov-report=html:$(COVERAGE_OUT) $(TEST)

fuzz: $(READY) ## odd input at every door: FUZZ=long for minutes, FUZZ="live" for the node over DDS; see CONTRIBUTING.md
	PYTHONPATH=tests:tests/models:tests/mpc $(BIN)/python -m fuzz $(FUZZ)

mutants: $(READY) ## change the core in 200 small ways, and list those that no test notices: an hour; MUTANTS="--count 40 --seed 7"
	$(BIN)/python tests/mutants.py $(MUTANTS)

lint: $(READY) ## style, format, language, C sources and shell scripts
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/python .ci/language.py
	git ls-files '*.c' '*.h' | xargs $(BIN)/clang-format --dry-run --Werror
	$(BIN)/shellcheck --severity=warning .ci/long .ci/run .ci/test_package docker/*.sh ros/security/*.sh

types: $(READY) ## strict type check
	$(BIN)/mypy

format: $(READY) ## apply the format
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .
	git ls-files '*.c' '*.h' | xargs $(BIN)/clang-format -i

models: $(READY) ## identify MBM and SM again from experiments on the simulated robot
	$(BIN)/python -m studies models fit

calibrate: $(READY) ## fit the simulated robot to the published SSM again
	$(BIN)/python -m studies models calibrate

readme: $(READY) ## copy tables and figures of the last `make bench` and of the studies that were made into README and docs
	$(BIN)/python -m studies.documents.documents $(OUT) $(wildcard $(STUDY_OUT)/tracking $(STUDY_OUT)/reproduce $(STUDY_OUT)/speed $(STUDY_OUT)/peers $(EDGE_OUT) $(ROBUSTNESS_OUT) $(PROVE_OUT))

STUDIES_SHOWN = tracking reproduce speed peers predicted-error

results: $(READY) ## every report of the documents anew, and into the documents: some hours on a quiet machine
	$(MAKE) bench-full edge robustness market prove tune
	for name in $(STUDIES_SHOWN); do $(MAKE) study NAME=$$name || exit 1; done
	$(BIN)/python -m studies.documents.documents $(OUT) $(EDGE_OUT) $(ROBUSTNESS_OUT) $(MARKET_OUT) $(PROVE_OUT) $(TUNE_OUT) \
		$(addprefix $(STUDY_OUT)/,$(STUDIES_SHOWN))

schemas: $(READY) ## write the JSON Schemas of controller, model and trajectory files again
	$(BIN)/python -m diffdrive_mpc.app.schemas

site: $(READY) ## the documents as a site: out/site
	$(BIN)/python -m studies.site.staging out/site-pages
	@NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --site-dir $(SITE_OUT)
	@echo "$(SITE_OUT)/index.html"

lab: $(LAB_READY) ## the laboratory, one page for a browser that needs nothing else: docs/laboratory/index.html
	$(BIN)/diffdrive-mpc lab --out $(LAB_OUT)

notebooks: $(READY) ## notebooks and pictures of the tutorials, from their pages
	$(BIN)/python -m studies.site.notebooks

pictures: $(READY) ## pictures of the documents that no study leaves
	$(BIN)/python -m studies.site.pictures

requirements: ## pin all dependencies anew (needs uv)
	uv pip compile pyproject.toml --extra dev --universal --python-version 3.11 --generate-hashes \
		--no-emit-index-url --no-emit-find-links --no-header --quiet --output-file requirements.txt
	echo 'setuptools>=77' | uv pip compile pyproject.toml - --constraint requirements.txt --universal --python-version 3.11 \
		--generate-hashes --no-emit-index-url --no-emit-find-links --no-header --no-annotate --quiet \
		--output-file requirements-bench.txt
	for list in .ci/colcon .ci/tools .ci/lab .ci/coverage; do uv pip compile $$list.in $(HASHED) --output-file $$list.txt || exit 1; done
	uv pip compile $(PEERS_LIST).in --no-deps $(HASHED) --output-file $(PEERS_LIST).txt

bill: $(READY) ## what is installed, with versions, hashes and licences, as CycloneDX: out/bill.json
	$(BIN)/python .ci/tools.py bill $(BIN)/python $(BILL_OUT)

audit: $(READY) ## known vulnerabilities of what is pinned; says so where nobody could be asked
	$(BIN)/python .ci/tools.py audit requirements.txt requirements-bench.txt .ci/colcon.txt .ci/lab.txt .ci/coverage.txt $(PEERS_LIST).txt

clean: ## remove what make has built
	rm -rf $(VENV) out dist .mypy_cache .ruff_cache .pytest_cache .hypothesis *.egg-info
