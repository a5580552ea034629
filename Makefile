# `make plan` and `make test` work in a clean clone: they make .venv and install what they need.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt

SYSTEM_PACKAGES := libegl1 libegl-mesa0 libgl1 libgl1-mesa-dri libgles2 libglib2.0-0 chromium

.PHONY: plan test check sim system-packages clean

plan: $(VENV)/.serve
	$(BIN)/looktwice plan

test: $(VENV)/.dev system-packages check
	$(BIN)/python -m pytest

check: $(VENV)/.dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

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
	rm -rf $(VENV) build *.egg-info
